"""`pp-cl train`: what it prints about how settings were read."""

import json

from support.runs import arguments, train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.presets import RENAMED


def test_an_old_key_is_taken_and_named_on_one_line(tmp_path, capsys):
    scene, out = write_ball_scene(tmp_path / "ball"), tmp_path / "run"
    assert main([*arguments(scene, out, train__iterations=2), "--set", "train.phases=false"]) == 0
    notes = [x for x in capsys.readouterr().err.splitlines() if x.startswith("pp-cl: ")]
    assert notes == ["pp-cl: --set: train.phases is called train.pixel_jitter now"]
    assert json.loads((out / "config.json").read_text())["train"]["pixel_jitter"] is False


def test_a_run_with_old_keys_resumes_and_gets_the_new_ones(tmp_path, capsys, monkeypatch):
    """Before raster.blend there was, all was softmax."""
    scene, out = write_ball_scene(tmp_path / "ball"), tmp_path / "run"
    train_and_interrupt(scene, out, 15, monkeypatch, raster__blend="softmax")
    new = json.loads((out / "config.json").read_text())
    old = json.loads((out / "config.json").read_text())
    for former, key in RENAMED.items():
        section, name = key.split(".")
        former_section, former_name = former.split(".")
        old[former_section][former_name] = old[section].pop(name)
    del old["raster"]
    (out / "config.json").write_text(json.dumps(old))
    capsys.readouterr()
    assert main(arguments(scene, out, raster__blend="softmax")) == 0
    captured = capsys.readouterr()
    notes = [line for line in captured.err.splitlines() if "is called" in line]
    assert len(notes) == 1 and "other keys" in notes[0] and "resuming at step 10" in captured.out
    assert json.loads((out / "config.json").read_text()) == new
