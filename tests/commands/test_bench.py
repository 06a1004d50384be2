"""`pp-cl bench train`, and options that belong to another bench."""

import json

import pytest
from support.bench_results import result
from support.scenes import write_ball_scene

from pp_cl.bench import estimate, overview
from pp_cl.cli import main


def test_train_prints_and_writes_its_row(tmp_path, capsys):
    scene, file = write_ball_scene(tmp_path / "ball", size=40), tmp_path / "b.json"
    words = ["--scene", scene, "--points", "1500", "--set", "raster.tau=0.001"]
    assert main(["bench", "train", *words, "--json", str(file)]) == 0
    printed, result = capsys.readouterr().out, json.loads(file.read_text())
    (row,) = result["rows"]
    assert result["device"] and f"{row['points']} points" in printed
    assert all(name in printed for name in row["stages_ms"])
    assert "estimated" not in printed


def test_train_reports_beside_an_estimate(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(estimate, "measured_card", lambda dev: estimate.Card(1e9, 1e12))
    scene = write_ball_scene(tmp_path / "ball", size=40)
    assert main(["bench", "train", "--scene", scene, "--points", "1500", "--report"]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = lines.index("| stage | measured, ms | estimated from these rates, ms |")
    rows = [line.split("|")[1:-1] for line in lines[first + 2 :] if line]
    # the pairs are kept, not built
    assert [row[0].strip() for row in rows] == [
        *("project", "weights", "shade", "blend", "backward", "update")
    ]
    measured, estimated = ([float(row[i]) for row in rows] for i in (1, 2))
    assert min(measured) > 0 and min(estimated) > 0
    # of a network of 16 channels: the paper's takes more than 0.1 s at 1 GB/s
    assert estimated[-1] < 50


@pytest.mark.parametrize(
    "words, named",
    [
        (["train", "--points", "10,20"], "--points 10,20: write one number"),
        (["train", "--set", "train.sped=1"], "train.sped"),
        (["train", "--scene", "/nowhere"], "/nowhere"),
        (["train", "--tau", "0"], "--tau"),
        (["train", "--plot", "b.png"], "--plot"),
        (["raster", "--set", "train.seed=1"], "--set"),
        (["unet", "--scene", "demo"], "--scene"),
        (["raster", "--gamma", "0.1,0.2"], "--gamma"),
    ],
)
def test_options_of_another_bench_are_one_line(words, named, capsys):
    assert main(["bench", *words]) == 2
    error = capsys.readouterr().err
    assert named in error and error.count("\n") == 1


def test_all_writes_a_page_and_its_numbers(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(overview, "bench_overview", lambda dev, policy, budget, tell: result())
    assert main(["bench", "--budget", "3s", "--out", str(tmp_path / "page")]) == 0
    assert json.loads((tmp_path / "page" / "bench.json").read_text()) == result()
    assert "<h2>Time against error</h2>" in (tmp_path / "page" / "bench.html").read_text()
    printed = capsys.readouterr().out
    assert str(tmp_path / "page" / "bench.html") in printed and "estimated" not in printed


def test_all_reports_beside_an_estimate(tmp_path, capsys, monkeypatch):
    counts = {"points": 1000, "pairs": 5000, "shaded": 400, "height": 64, "width": 32}
    found = result()
    found["training"]["counts"] = counts
    monkeypatch.setattr(overview, "bench_overview", lambda dev, policy, budget, tell: found)
    monkeypatch.setattr(estimate, "measured_card", lambda dev: estimate.Card(1e9, 1e12))
    assert main(["bench", "--report", "--out", str(tmp_path / "page")]) == 0
    printed = capsys.readouterr().out
    assert "tiny, 1000 points, 5000 hits and 400 shaded points in 32x64 pixels" in printed
    assert "\n| project | 33.2 | 0.037 |\n" in printed  # 32 bytes a point, and a launch


@pytest.mark.parametrize(
    "words, named",
    [
        (["unet", "--report"], "--report"),
        (["--budget", "0"], "--budget"),
        (["--budget", "long"], "--budget"),
        (["--json", "b.json"], "--json"),
        (["all", "--size", "64"], "--size"),
        (["unet", "--budget", "9"], "--budget"),
        (["--tolerance", "1e-5"], "--tolerance"),
    ],
)
def test_all_refuses_in_one_line(words, named, capsys):
    assert main(["bench", *words]) == 2
    error = capsys.readouterr().err
    assert named in error and error.count("\n") == 1


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path, capsys):
    (tmp_path / "file").write_text("x")
    assert main(["bench", "--out", str(tmp_path / "file")]) == 2
    error = capsys.readouterr().err
    assert str(tmp_path / "file") in error and error.count("\n") == 1
