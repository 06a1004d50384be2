"""What a training goes on with, and what it refuses: other settings, another scene, checkpoints
that lack something.
"""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from support.runs import arguments, train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.files.checkpoint import load_checkpoint, save_checkpoint


def test_a_finished_run_is_left_alone(scene, finished, capsys):
    before = (finished / "checkpoint.npz").stat().st_mtime_ns
    assert main(arguments(scene, finished)) == 0
    assert "is finished" in capsys.readouterr().out
    assert (finished / "checkpoint.npz").stat().st_mtime_ns == before


def test_settings_are_taken_from_the_run_and_may_not_change(scene, finished, capsys):
    assert main(["train", scene, "--out", str(finished)]) == 0
    assert main(["train", scene, "--out", str(finished), "--iterations", "61"]) == 2
    assert "train.iterations is 60 there, 61 asked for" in capsys.readouterr().err


def test_a_checkpoint_of_another_scene_is_refused(scene, tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    train_and_interrupt(scene, out, 15, monkeypatch)
    header, arrays = load_checkpoint(out / "checkpoint.npz")
    header.pop("format")
    save_checkpoint(out / "checkpoint.npz", header | {"scene": "0" * 64}, arrays)
    before = (out / "checkpoint.npz").read_bytes()
    assert main(arguments(scene, out)) == 2
    assert "belongs to another scene" in capsys.readouterr().err
    assert (out / "checkpoint.npz").read_bytes() == before


def test_a_scene_that_has_moved_is_known_by_its_views(scene, finished, tmp_path, monkeypatch):
    train_and_interrupt(scene, tmp_path / "run", 25, monkeypatch)
    shutil.copytree(scene, tmp_path / "moved")
    assert main(arguments(str(tmp_path / "moved"), tmp_path / "run")) == 0
    assert (tmp_path / "run" / "checkpoint.npz").read_bytes() == (
        finished / "checkpoint.npz"
    ).read_bytes()
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["scene"]["path"] == str(tmp_path / "moved")


def test_a_scene_whose_pixels_have_changed_is_refused(scene, tmp_path, capsys, monkeypatch):
    folder, out = tmp_path / "ball", tmp_path / "run"
    shutil.copytree(scene, folder)
    train_and_interrupt(str(folder), out, 15, monkeypatch)
    before = (out / "checkpoint.npz").read_bytes()
    pixels = np.array(Image.open(folder / "train" / "r_3.png"))
    pixels[0, 0, 0] ^= 1
    Image.fromarray(pixels).save(folder / "train" / "r_3.png")
    assert main(arguments(str(folder), out)) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "belongs to another scene" in error and "train/r_3.png: other pixels" in error
    assert (out / "checkpoint.npz").read_bytes() == before


def test_a_checkpoint_without_digests_goes_on_with_one_line(
    scene, finished, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "run"
    train_and_interrupt(scene, out, 15, monkeypatch)
    header, arrays = load_checkpoint(out / "checkpoint.npz")
    del header["format"], header["pixels"]
    save_checkpoint(out / "checkpoint.npz", header, arrays)
    capsys.readouterr()
    assert main(arguments(scene, out)) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "digests" in line]
    assert len(told) == 1 and str(out / "checkpoint.npz") in told[0]
    assert (out / "checkpoint.npz").read_bytes() == (finished / "checkpoint.npz").read_bytes()


@pytest.mark.parametrize("steps", [25, 5, 60])
def test_another_scene_is_refused_at_any_state_of_the_run(
    scene, tmp_path, capsys, monkeypatch, steps
):
    """With a checkpoint, before the first, and when the run is finished."""
    out, other = tmp_path / "run", write_ball_scene(tmp_path / "other", views=7)
    if steps == 60:
        assert main(arguments(scene, out)) == 0
    else:
        train_and_interrupt(scene, out, steps, monkeypatch)
    before = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    assert main(arguments(other, out)) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert ("belongs to another scene" if steps == 25 else "scene.path is ") in error
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == before


@pytest.mark.parametrize(
    "lost", ["moment.m.enc0.a.weight", "state.v.sh", "state.last_step", "state.peak_weight"]
)
def test_a_checkpoint_without_its_training_state_is_refused(
    scene, tmp_path, capsys, monkeypatch, lost
):
    train_and_interrupt(scene, tmp_path / "run", 15, monkeypatch)
    header, arrays = load_checkpoint(tmp_path / "run" / "checkpoint.npz")
    arrays.pop(lost)
    save_checkpoint(
        tmp_path / "run" / "checkpoint.npz",
        {k: v for k, v in header.items() if k != "format"},
        arrays,
    )
    assert main(arguments(scene, tmp_path / "run")) == 2
    assert lost in capsys.readouterr().err
    save_checkpoint(tmp_path / "run" / "checkpoint.npz", {"step": 10}, arrays)
    assert main(arguments(scene, tmp_path / "run")) == 2
    assert "header lacks scene" in capsys.readouterr().err
