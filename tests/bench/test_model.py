"""Frames per second against PSNR: every way of making a run smaller, by itself."""

import json

import pytest

from pp_cl.bench import model as module
from pp_cl.bench.model import TRIED, bench_models, line
from pp_cl.cli import main
from pp_cl.compress.reduction import measured_psnr
from pp_cl.run import load_run


@pytest.fixture(scope="module")
def trained(runs, tmp_path_factory):
    """Two runs of 20 steps, the second with one convolution a level."""
    folder, scene = tmp_path_factory.mktemp("model"), runs.ball(views=9, size=40)
    for name, blocks in (("a", "double"), ("b", "single")):
        changes = {"train__iterations": 20, "network__blocks": blocks, "train__previews": 0}
        runs.trained(folder / name, scene, 1, **changes)
    return folder


def test_rows_of_two_runs(dev, trained, monkeypatch):
    monkeypatch.setattr(module, "TRIED", TRIED | {"keep": (0.5,)})
    runs = [load_run(dev, trained / name) for name in "ab"]
    rows = list(bench_models(runs))
    by_name = {row["what"]: row for row in rows}
    first, second = rows[:2]
    assert (first["loss"], first["what"]) == (0, str(runs[0].folder))
    views = runs[0].scene("test").splits["test"]
    picked = [views[i * len(views) // min(8, len(views))] for i in range(min(8, len(views)))]
    assert first["psnr"] == pytest.approx(measured_psnr(runs[0], picked))
    assert second["bytes"] < first["bytes"]
    saved = first["bytes"] - by_name["half"]["bytes"]
    assert saved == first["points"] * 9 * 16 * 2
    assert abs(by_name["half"]["loss"]) < 0.05
    assert by_name["keep 0.5"]["points"] == round(first["points"] / 2)
    assert by_name["degree 0"]["bytes"] < by_name["degree 1"]["bytes"] < first["bytes"]
    assert by_name["early_stop 0.03"]["loss"] != 0
    assert abs(by_name["convolutions by direct"]["loss"]) < 0.01
    for row in rows:
        assert row["ms"] > 0 and row["speed"] > 0
        assert row["loss"] == pytest.approx(first["psnr"] - row["psnr"])
        assert f"{row['psnr']:.2f}" in line(row)


def test_the_command(trained, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(module, "TRIED", {"half": (True,)})
    file = tmp_path / "m.json"
    assert main(["bench", "model", "--runs", str(trained / "a"), "--json", str(file)]) == 0
    rows = json.loads(file.read_text())["rows"]
    printed = capsys.readouterr().out
    assert all(row["what"] in printed for row in rows) and rows[1]["what"] == "half"
