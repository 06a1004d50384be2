"""tools/ablate.py: its arithmetic, its file of results, and that finished runs are reused."""

import importlib.util
import json
from pathlib import Path

import pytest
from support.scenes import write_ball_scene

from pp_cl.train import Trainer

pytestmark = pytest.mark.slow


def load_tool(name):
    path = Path(__file__).parents[2] / "tools" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TOOL, TABLES = load_tool("ablate"), load_tool("docs_tables")
SMALL = ["network.widths=16,16,16", "points.count=800", "train.crop=24", "train.previews=0"]


def row(blocks, seed, psnr, step_ms):
    return {"blocks": blocks, "seed": seed, "psnr": psnr, "step_ms": step_ms}


def test_mean_lowest_and_highest():
    rows = [row("single", 1, 28.0, 10.0), row("double", 1, 30.0, 20.0), row("gated", 1, 29.0, 30.0)]
    rows += [row("single", 2, 28.5, 11.0), row("double", 2, 31.0, 24.0)]
    double, single, gated = TOOL.summary(rows, (128, 256, 512))
    assert [line["parameters"] for line in (double, single, gated)] == [
        6_968_579,
        3_133_443,
        6_102_275,
    ]
    assert (double["psnr"], double["psnr_low"], double["psnr_high"]) == (30.5, 30.0, 31.0)
    assert (single["step_ms"], single["step_ms_low"], single["step_ms_high"]) == (10.5, 10, 11)
    assert gated["psnr"] == gated["psnr_low"] == gated["psnr_high"] == 29.0
    assert double["seeds"] == [1, 2] and gated["seeds"] == [1] and "ssim" not in double


def test_a_setting_has_one_row_of_words():
    assert tuple(TOOL.WORDS) == TOOL.BLOCKS


def test_runs_alternate_between_the_blocks(tmp_path):
    jobs = TOOL.plan_runs("demo", tmp_path, 7, [1, 2], given=[])
    assert [(job.seed, dict(job.varied)["network.blocks"]) for job in jobs] == [
        (seed, blocks) for seed in (1, 2) for blocks in ("double", "single", "gated")
    ]
    assert {job.iterations for job in jobs} == {7}
    assert len({job.folder for job in jobs}) == 6


def test_a_small_ablation_and_the_same_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(TOOL, "METRICS", ("psnr", "ssim"))  # LPIPS wants weights and large images
    scene, file = write_ball_scene(tmp_path / "ball", views=3), tmp_path / "t.json"
    words = [scene, "--out", str(tmp_path / "runs"), "--steps", "3", "--seeds", "4,5"]
    words += ["--json", str(file), "--downscale", "2"]
    words += [word for text in SMALL for word in ("--set", text)]
    assert TOOL.main(words) == 0
    found, printed = json.loads(file.read_text()), capsys.readouterr().out
    assert printed.count("ball network.blocks=") == 6
    assert len({line["parameters"] for line in found["rows"]}) == 3
    for line in found["rows"]:
        assert line["seeds"] == [4, 5] and line["step_ms_low"] > 0 and line["frame_ms_low"] > 0
        for key in ("psnr", "ssim", "step_ms", "frame_ms"):
            assert line[f"{key}_low"] <= line[key] <= line[f"{key}_high"]
    evaluated = (tmp_path / "runs/ball/network.blocks=gated/seed-5/eval/metrics.json").read_text()
    psnr = json.loads(evaluated)["mean"]["psnr"]
    assert psnr in (found["rows"][2]["psnr_low"], found["rows"][2]["psnr_high"])

    table = TABLES.table(found)
    assert "3 steps: mean (lowest to highest) of seeds 4, 5" in table
    assert table.count("\n| ") == 4 and str(tmp_path) not in table
    assert f"| {found['rows'][0]['psnr']:.2f} ({found['rows'][0]['psnr_low']:.2f} to " in table

    def forbidden(self):
        raise AssertionError("a finished run was trained again")

    monkeypatch.setattr(Trainer, "train_step", forbidden)
    assert TOOL.main(words) == 0
    assert json.loads(file.read_text()) == found


@pytest.mark.parametrize(
    "words, named",
    [
        (["--json", "/nowhere/a.json"], "--json /nowhere/a.json"),
        (["--seeds", "x"], "--seeds"),
        (["--steps", "0"], "train.iterations"),
        (["--set", "network.blocks=single"], "network.blocks"),
        (["--set", "train.seed=1"], "train.seed"),
        (["--downscale", "x"], "--downscale"),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, words, named):
    assert TOOL.main(["demo", "--out", str(tmp_path / "runs"), *words]) == 2
    told = capsys.readouterr().err
    assert named in told and told.count("\n") == 1
    assert not (tmp_path / "runs").exists()
