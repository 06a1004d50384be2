import itertools
import json
import shutil

import pytest
from support.checkpoints import load_checkpoint
from support.refused import failure
from support.runs import arguments, checkpoint, rows, train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.engine.step import Trainer

LOOKS = "pp_cl.engine.training.schedule.PRUNE_LOOKS", 4  # 4 looks at points are enough for pruning


def test_a_finished_run_is_left_alone(scene, finished, capsys):
    before = (finished / "checkpoint.npz").stat().st_mtime_ns
    assert main(arguments(scene, finished)) == 0
    assert "is finished" in capsys.readouterr().out
    assert (finished / "checkpoint.npz").stat().st_mtime_ns == before


def test_settings_are_taken_from_the_run_and_may_not_change(scene, finished, capsys):
    words = ["train", scene, "--out", str(finished)]
    assert main(words) == main([*words, "--iterations", "59"]) == 0
    assert main(["train", "--out", str(finished)]) == 0  # the scene is taken from the run, too
    assert capsys.readouterr().out.count("is finished (60 steps)") == 3
    assert failure("train", "--out", finished / "other").startswith("pp-cl: SCENE: ")
    error = failure(*words, "--points", "1600", "--iterations", "61")
    assert "points.count is 1500 in this run, but 1600 is asked for" in error


def test_to_ask_for_what_is_automatic_is_to_ask_for_what_was_chosen(scene, finished, capsys):
    words = ["train", scene, "--out", str(finished), "--set"]
    assert main([*words, "train.view_opacity=auto"]) == 0
    assert "is finished (60 steps)" in capsys.readouterr().out
    for other in ("train.view_opacity=off", "train.refine_at=0,0"):  # refine_at was given
        assert f"{other.partition('=')[0]} is " in failure(*words, other)


def measured_psnr(out):
    assert main(["eval", str(out)]) == 0
    return json.loads((out / "eval" / "metrics.json").read_text())["mean"]["psnr"]


@pytest.fixture(scope="module")
def refined(scene, tmp_path_factory):
    """(Folder of a finished run with one refinement, function of the words of a longer one)."""
    out, changes = tmp_path_factory.mktemp("runs") / "refined", {"train__refine_at": "0.35,1"}
    changes |= {"points__count": 300, "train__checkpoint_every": 3, "train__prune_weight": 0.05}
    changes["raster__radius"] = 1  # points lie 3 pixels apart

    def words(out, iterations):
        return arguments(scene, out, downscale=1, train__iterations=iterations, **changes)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*LOOKS)
        assert main(words(out, 20)) == 0
    return out, words


@pytest.mark.parametrize("iterations, stop", [(22, 21), (80, 69)])
def test_a_finished_run_is_extended_and_resumes_to_the_same_bytes(
    refined, tmp_path, monkeypatch, capsys, iterations, stop
):
    monkeypatch.setattr(*LOOKS)
    capsys.readouterr()
    (whole, stopped), (out, words) = [tmp_path / name for name in ("whole", "stopped")], refined
    for folder in (whole, stopped):
        shutil.copytree(out, folder)
    assert main(words(whole, iterations)) == 0
    assert "extends a finished training of 20 steps" in capsys.readouterr().out
    header, _ = load_checkpoint(whole / "checkpoint.npz")
    assert header["finished"] and (header["step"], header["extended_from"]) == (iterations, 20)
    config = json.loads((whole / "config.json").read_text())
    assert config["train"]["iterations"] == iterations
    log = rows(whole)
    assert [row["step"] for row in log[:4]] == [5, 10, 15, 20] and log[-2]["step"] == iterations
    for before, after in itertools.pairwise(log[3:]):
        assert before["points"] >= after["points"] and before["seconds"] <= after["seconds"]
    before, after = measured_psnr(out), measured_psnr(whole)
    assert after > before + (1 if iterations == 80 else -0.5), (before, after)
    for step in (20, stop):  # stop before the first new step, then later
        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "train_step", interrupted_after(step))
            assert main(words(stopped, iterations)) == 130
        assert load_checkpoint(stopped / "checkpoint.npz")[0]["step"] == step
        assert main(["eval", str(stopped), "--metrics", "psnr"]) == 0
    assert main(words(stopped, 20)) == 2  # it is already extended to more steps
    assert main(words(stopped, iterations)) == 0
    assert checkpoint(stopped) == checkpoint(whole)


def interrupted_after(step, train_step=Trainer.train_step):
    def stopping(self):
        if self.step == step:
            raise KeyboardInterrupt
        return train_step(self)

    return stopping


def test_a_scene_that_has_moved_is_known_by_its_views(scene, finished, tmp_path, monkeypatch):
    train_and_interrupt(scene, tmp_path / "run", 25, monkeypatch)
    shutil.copytree(scene, tmp_path / "moved")
    assert main(arguments(str(tmp_path / "moved"), tmp_path / "run")) == 0
    assert checkpoint(tmp_path / "run") == checkpoint(finished)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["scene"]["path"] == str(tmp_path / "moved")


@pytest.mark.parametrize("steps", [25, 5, 60])
def test_another_scene_is_refused_at_any_state_of_the_run(
    runs, scene, tmp_path, monkeypatch, steps
):
    out, other = tmp_path / "run", write_ball_scene(tmp_path / "other", views=7)
    if steps == 60:
        runs.trained(out, scene)
    else:
        train_and_interrupt(scene, out, steps, monkeypatch)
    before = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    error = failure(*arguments(other, out))
    assert ("belongs to another scene" if steps == 25 else "scene.path is ") in error
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == before


def test_a_refined_run_resumes_to_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(*LOOKS)
    scene = write_ball_scene(tmp_path / "ball")
    changes = {"train__refine_at": "0.9,1", "points__count": 300, "train__prune_weight": 0.05}
    changes |= {"downscale": 1, "train__supersampled": 0.07}  # supersampled from step 56 on
    assert main(arguments(scene, tmp_path / "whole", **changes)) == 0
    whole = checkpoint(tmp_path / "whole")
    points = {row["step"]: row["points"] for row in rows(tmp_path / "whole")[:-1]}
    assert points[55] > 4 * points[50]
    for steps in (52, 57):
        out = tmp_path / str(steps)
        train_and_interrupt(scene, out, steps, monkeypatch, **changes)
        assert main(arguments(scene, out, **changes)) == 0
        assert checkpoint(out) == whole
