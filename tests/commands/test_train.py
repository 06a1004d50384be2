import json
import re
from types import SimpleNamespace

import numpy as np
from support.refused import failure
from support.runs import SETTINGS, arguments
from support.scenes import write_ball_scene

from pp_cl.checkpoint import save_checkpoint
from pp_cl.cli import main
from pp_cl.config import AUTOMATIC, begin_with, load_config, run_config
from pp_cl.errors import UserError
from pp_cl.files.image import write_png
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.training import train_scene


def trained_lines(capsys, *words):
    few = ["--iterations", "2", "--points", "300", "--set", "network.widths=16,16,16"]
    assert main(["train", *map(str, words), *few]) == 0
    return capsys.readouterr().out.splitlines()


def test_a_preset_reduces_large_images_and_says_so(tmp_path, capsys):
    scene, out = write_ball_scene(tmp_path / "ball", views=4, size=400), tmp_path / "run"
    lines = trained_lines(capsys, scene, "--out", out)
    assert "images: scaled from 400x400 to 200x200" in lines
    assert "size: images reduced 2 times for the preset tiny (--downscale 1 keeps them)" in lines
    assert json.loads((out / "config.json").read_text())["scene"]["downscale"] == 2
    option = ("--set", "scene.downscale=1")
    assert "images: 400x400" in trained_lines(capsys, scene, "--out", tmp_path / "b", *option)


def test_a_full_disk_is_told_before_the_first_step(scene, tmp_path, monkeypatch):
    free = SimpleNamespace(free=10_000)
    monkeypatch.setattr("shutil.disk_usage", lambda _: free)
    line = failure(*arguments(scene, tmp_path / "run"))
    assert re.search(r"run/checkpoint.npz: takes \d+ MB, and 0 are free on its disk; free", line)
    assert not (tmp_path / "run/log.jsonl").exists()
    free.free = 10**9
    assert main([str(word) for word in arguments(scene, tmp_path / "run")]) == 0


def test_memory_and_what_is_left_out_are_a_line_each(tmp_path, capsys):
    scene = write_ball_scene(tmp_path / "ball", views=4)
    refined = ("--downscale", "1", "--set", "train.refine_at=0.3,0.6")
    lines = trained_lines(capsys, scene, "--out", tmp_path / "a", *refined)
    assert sum(line.startswith("refinements: 1 of the 2 ") for line in lines) == 1
    assert sum(line.startswith("memory") for line in lines) == 1 and len(lines) < 12


def failing_step(self):
    raise UserError("the loss is not finite at step 1; lower network.rate")


def test_a_start_without_a_checkpoint_takes_other_settings(tmp_path, monkeypatch):
    """A training that fails in its first steps advises other settings; the next one keeps nothing
    of it.
    """
    scene, out, plain = write_ball_scene(tmp_path / "ball"), tmp_path / "run", tmp_path / "plain"
    with monkeypatch.context() as patch:
        patch.setattr("pp_cl.engine.step.Trainer.train_step", failing_step)
        assert main(arguments(scene, out, network__rate="100,100")) == 2
    write_png(out / "previews" / "step_000001.png", np.zeros((8, 8, 3)))  # by the first settings
    words = {"network__rate": "0.002,0.001", "train__iterations": 12, "train__refine_at": "1,1"}
    assert main([*arguments(scene, out, **words), "--preset", "small"]) == 0
    assert main([*arguments(scene, plain, **words), "--preset", "small"]) == 0
    for name in ("checkpoint.npz", "config.json"):
        assert (out / name).read_bytes() == (plain / name).read_bytes()
    assert not (out / "previews" / "step_000001.png").exists()
    error = failure(*arguments(scene, out, **words), "--preset", "tiny")
    assert "preset is small in this run" in error


def test_automatic_settings_are_chosen_anew(tmp_path, monkeypatch):
    scene, folder = write_ball_scene(tmp_path / "ball"), RunFolder(tmp_path / "run")
    words = arguments(scene, folder.path, train__refine_at="0,0", raster__radius=0)
    with monkeypatch.context() as patch:
        patch.setattr("pp_cl.engine.step.Trainer.train_step", failing_step)
        assert main(words) == 2
    stored = load_config(folder.config)
    assert {*AUTOMATIC} <= {*stored.decisions} and stored.raster.radius > 0
    assert stored.train.view_opacity == "on"
    config = run_config(folder, scene)
    assert (config.train.refine_at, config.raster.radius) == ((0, 0), 0)
    assert config.train.view_opacity == "auto"
    _, settings = begin_with(folder.config, [])
    assert not {*AUTOMATIC} & {key for key, _, _ in settings}
    own = [("raster.radius", "0.9", "--set")]
    assert run_config(folder, scene, None, own).raster.radius == 0.9


def test_a_checkpoint_goes_on_with_what_the_model_does_not_depend_on(tmp_path):
    scene, folder = write_ball_scene(tmp_path / "ball"), RunFolder(tmp_path / "run")
    train_scene(scene, folder.path, settings=SETTINGS, is_stopped=lambda: True)
    other = ("--memory", "7", "--set", "train.checkpoint_every=50", "--set", "train.log_every=20")
    assert main(["train", "--out", str(folder.path), *other]) == 0
    assert load_config(folder.config).train.memory_gib == 7


def test_a_row_and_a_preview_stand_before_the_checkpoint_that_holds_their_step(
    tmp_path, monkeypatch
):
    """Otherwise, if the process is killed in between, they would be missing for ever."""
    scene, folder, written = write_ball_scene(tmp_path / "ball"), RunFolder(tmp_path / "run"), {}

    def saving(path, header, arrays):
        rows = [json.loads(line) for line in folder.log.read_text().splitlines()]
        images = sorted(int(path.stem[5:]) for path in folder.previews.iterdir())
        written[header["step"]] = rows[-1]["step"], rows[-1].get("finished"), images[-1:]
        save_checkpoint(path, header, arrays)

    monkeypatch.setattr("pp_cl.session.training.save_checkpoint", saving)
    monkeypatch.setattr("pp_cl.session.training.PREVIEWS", 3)
    assert main(arguments(scene, folder.path, train__checkpoint_every=20)) == 0
    assert written == {20: (20, None, [20]), 40: (40, None, [40]), 60: (60, True, [60])}


def test_a_run_begins_with_the_settings_of_another(tmp_path, capsys):
    scene, file = write_ball_scene(tmp_path / "ball", views=4), tmp_path / "first" / "config.json"
    changed = ("--set", "train.sh_eps=0.02", "--downscale", "1")
    trained_lines(capsys, scene, "--out", tmp_path / "first", *changed)
    other, out = write_ball_scene(tmp_path / "other", views=5), tmp_path / "second"
    words = ["train", other, "--out", str(out), "--config", str(file)]
    assert main([*words, "--seed", "3"]) == 0
    first, second = (json.loads(path.read_text()) for path in (file, out / "config.json"))
    assert second["scene"]["path"] == other and second["train"]["seed"] == 3
    second["train"]["seed"] = first["train"]["seed"]
    for section in ("points", "raster", "network", "train"):
        assert second[section] == first[section]
    assert second["train"]["sh_eps"] == 0.02 and second["train"]["iterations"] == 2
    capsys.readouterr()
    assert main([*words, "--seed", "3"]) == 0 and "finished" in capsys.readouterr().out
    assert main([*words, "--seed", "3", "--iterations", "4"]) == 0
    assert "trained 4 steps" in capsys.readouterr().out
