"""The folder of a compressed run, and the command."""

import json
import shutil

import numpy as np
from support.refused import failure
from support.runs import train_and_interrupt

from pp_cl.cli import main
from pp_cl.compress.search import validation_views
from pp_cl.config import load_config
from pp_cl.export.length import metres_per_unit
from pp_cl.run import load_run


def test_validation_views_are_never_those_of_the_test(dev, ball_run, tmp_path):
    run = load_run(dev, ball_run)
    which, views, error = validation_views(run)
    assert which == "2 views of train" and error == 0
    train = run.scene("train").splits["train"]
    assert [view.name for view in views] == [train[0].name, train[8].name]
    scene = tmp_path / "scene"
    shutil.copytree(run.config.scene.path, scene)
    shutil.copy(scene / "transforms_test.json", scene / "transforms_val.json")
    with_val = load_run(dev, ball_run, scene=str(scene))
    which, views, _ = validation_views(with_val)
    assert which == f"{len(views)} views of val"


def test_the_command_writes_a_run(ball_run, tmp_path, capsys, dev):
    """What is written is what was measured, and a run like any other."""
    out = tmp_path / "small"
    length = ball_run / "length.json"
    length.write_text('{"metres_per_unit": 0.05}')
    try:
        assert main(["compress", str(ball_run), "--max-loss", "3dB", "--out", str(out), "-v"]) == 0
    finally:
        length.unlink()
    assert metres_per_unit(load_run(dev, out)) == 0.05
    printed = capsys.readouterr().out
    report = json.loads((out / "compress.json").read_text())
    assert all(f"{trial['psnr']:.3f} dB" in printed for trial in report["trials"])
    assert "times less" in printed and report["loss"] <= 3 == report["most_loss"]
    assert report["bytes"][1] <= report["bytes"][0] / 1.9
    assert (out / "checkpoint.npz").stat().st_size < 1.1 * report["bytes"][1] + 20_000
    run = load_run(dev, out)
    assert run.model.cloud.sh[0].dtype == np.float16
    assert run.model.cloud.count == report["points"][1] < report["points"][0]
    assert run.config.scene.path == load_run(dev, ball_run).config.scene.path
    for words in (["eval", "--metrics", "psnr"], ["export", "--format", "ply"]):
        assert main([words[0], str(out), *words[1:]]) == 0


def test_an_unfinished_run_is_refused(ball_run, tmp_path, monkeypatch):
    scene = load_config(ball_run / "config.json").scene.path
    train_and_interrupt(scene, tmp_path / "run", 12, monkeypatch)
    assert "not finished" in failure("compress", tmp_path / "run")
