"""`pp-cl bench`: tables, files, and options that are refused."""

import json
import sys

import pytest
from support.benches import KEYS
from support.refused import failure
from support.scenes import write_ball_scene

from pp_cl.bench import timing
from pp_cl.cli import main
from pp_cl.commands import bench as command

SMALL = {
    "conv": ("--size", "8", "--widths", "16,16,16"),
    "raster": ("--points", "60,500", "--size", "12,20"),
}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Short runs, and few of them."""
    monkeypatch.setattr(timing, "COPY_BYTES", 2**16)
    monkeypatch.setattr(timing, "PEAK_SECONDS", 0.0)
    monkeypatch.setattr(timing, "SECONDS", 0.0)
    monkeypatch.setattr(timing, "LEAST_ROUNDS", 2)


def bench(tmp_path, *words):
    """What the bench wrote with --json."""
    file = tmp_path / "b.json"
    assert main(["bench", *words, "--json", str(file)]) == 0
    return json.loads(file.read_text())


def test_the_network_prints_and_writes_its_rows(tmp_path, capsys):
    result = bench(tmp_path, "conv", *SMALL["conv"])
    assert result["device"] and all(row.keys() >= KEYS for row in result["rows"])
    printed = capsys.readouterr().out
    rows = [row for row in result["rows"] if row["layer"] == "enc0.a"]
    assert printed.count("enc0.a") == len(rows) > 3 and "GFLOP/s" in printed


def test_the_rasteriser_prints_and_writes_its_rows(tmp_path, capsys):
    result = bench(tmp_path, "raster", *SMALL["raster"])
    assert result["device"] and len(result["rows"]) == 8
    assert capsys.readouterr().out.count("grid ") == 8


def test_train_prints_and_writes_its_row(tmp_path, capsys):
    scene = write_ball_scene(tmp_path / "ball", size=40)
    words = ["--scene", scene, "--points", "1500", "--set", "raster.early_stop=0.001"]
    result = bench(tmp_path, "train", *words)
    (row,), printed = result["rows"], capsys.readouterr().out
    assert result["device"] and f"ball {row['points']:>11}" in printed
    assert all(name in printed for name in row["stages_ms"])


def test_all_measures_each_bench(tmp_path, capsys, monkeypatch):
    small = {
        "conv": {"size": [8], "widths": (16, 16, 16)},
        "unet": {"size": [8], "widths": (16, 16, 16)},
        "raster": {"size": [16], "points": [100]},
        "train": {"points": [1000]},
    }
    assert small.keys() == command.SMALL.keys()
    monkeypatch.setattr(command, "SMALL", small)
    plot = tmp_path / "b.png"
    rows = bench(tmp_path, "--plot", str(plot))["rows"]
    assert list(dict.fromkeys(row["bench"] for row in rows)) == list(small)
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.count("\n") == 1 + 4 + len(rows)


@pytest.mark.parametrize("what", SMALL)
def test_a_plot_is_drawn(tmp_path, what):
    file = tmp_path / "b.png"
    assert main(["bench", what, *SMALL[what], "--plot", str(file)]) == 0
    assert file.read_bytes().startswith(b"\x89PNG")


def test_without_matplotlib_a_plot_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert "pip install matplotlib" in failure("bench", "--plot", tmp_path / "b.png")
