import json

import pytest

from pp_cl.bench import timing
from pp_cl.cli import main
from pp_cl.commands import bench as command


def bench(tmp_path, *words):
    file = tmp_path / "b.json"
    assert main(["bench", *words, "--json", str(file)]) == 0
    result = json.loads(file.read_text())
    assert result["device"]
    return result["rows"]


def test_all_measures_each_bench(tmp_path, capsys, monkeypatch):
    small = {
        "conv": {"size": [8], "widths": (16, 16, 16)},
        "unet": {"size": [8], "widths": (16, 16, 16)},
        "raster": {"size": [12, 20], "points": [60, 500]},
        "train": {"points": [1000], "widths": (16, 16, 16)},
    }
    assert small.keys() == command.SMALL.keys()
    monkeypatch.setattr(command, "SMALL", small)
    monkeypatch.setattr("pp_cl.scene.demo.TRAIN_VIEWS", 6)
    monkeypatch.setattr(timing, "SECONDS", 0.0)
    monkeypatch.setattr(timing, "LEAST_ROUNDS", 2)
    plot = tmp_path / "b.png"
    rows = bench(tmp_path, "--plot", str(plot))
    assert list(dict.fromkeys(row["bench"] for row in rows)) == list(small)
    assert plot.read_bytes().startswith(b"\x89PNG")
    _, head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["bench", "of", "variant", "ms", "rel.", "L2", "max"]
    assert [line.split()[0] for line in lines] == [row["bench"] for row in rows]
    first = rows[0]
    assert lines[0].split()[1:5] == ["enc0.a", "8x8x16x16x3", "forward", first["variant"]]
    assert f"{first['rel_l2']:.1e}" in lines[0] and "GFLOP/s" in lines[0]
    assert sum("grid" in line and "weights" in line for line in lines) == 8
    for row in rows:
        if row["bench"] == "conv":
            height, width, ci, co, k = row["shape"]
            passes = 1 if row["direction"] == "forward" else 2  # for inputs and for weights
            operations = passes * 2e-6 * k * k * ci * co * height * width
            assert row["rel_l2"] < 1e-5 and row["gflops"] == pytest.approx(operations / row["ms"])
        elif row["bench"] == "unet":
            assert 0 < row["rel_l2"] < 10 * 2e-6 and row["max_err"] > 0  # the U-Net has ten layers
        elif row["bench"] == "raster":
            assert row["forward_ms"] + row["backward_ms"] == pytest.approx(
                sum(row["stages_ms"].values())
            )
            assert 0 < row["visible"] <= row["points"] and 0 < row["max_err"] < 1e-4
        else:
            assert row["ms"] == pytest.approx(sum(row["stages_ms"].values()))
            assert row["peak_device_bytes"] > row["points"] * 4 * 145
