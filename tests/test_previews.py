"""Previews and measured views: what a run shows of itself on the way does not change it."""

import json
from pathlib import Path

import pytest
from support.refused import failure
from support.runs import arguments, checkpoint, rows, train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main


def test_views_are_measured_on_the_way_without_a_change_of_the_run(tmp_path, capsys):
    scene = write_ball_scene(tmp_path / "ball")
    plain, measured = tmp_path / "plain", tmp_path / "measured"
    last = {"train__prune_weight": 0}
    assert main(arguments(scene, plain, **last)) == 0
    assert main([*arguments(scene, measured, **last), "--eval-every", "12"]) == 0
    assert checkpoint(plain) == checkpoint(measured)
    log = rows(measured)
    tests = {row["step"]: row["test_psnr"] for row in log if "test_psnr" in row}
    assert list(tests) == [12, 24, 36, 48, 60] and tests[60] > tests[12] + 3
    assert all("psnr" in row for row in log[:-1])
    capsys.readouterr()
    assert main(["eval", str(measured), "--metrics", "psnr"]) == 0
    mean = json.loads((measured / "eval" / "metrics.json").read_text())["mean"]["psnr"]
    assert abs(mean - tests[60]) < 3  # the result has averaged parameters


def test_the_split_val_is_measured_where_there_is_one(tmp_path):
    scene = write_ball_scene(tmp_path / "ball", splits=("train", "val", "test"))
    (Path(scene) / "test" / "r_0.png").write_bytes(b"")  # is not read
    changes = {"train__iterations": 2, "train__eval_every": 1}
    assert main(arguments(scene, tmp_path / "run", **changes)) == 0
    alone = write_ball_scene(tmp_path / "alone", splits=("train",))
    assert "--eval-every" in failure(*arguments(alone, tmp_path / "other", **changes))
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    "changes",
    [{}, {"train__refine_at": "0.5,1", "downscale": 1, "points__count": 300}],
)
def test_previews_leave_the_run_as_it_is(tmp_path, monkeypatch, changes):
    """Many in places of their own, one of them by the clock, against none but the last."""
    scene = write_ball_scene(tmp_path / "ball")
    none, many = tmp_path / "none", tmp_path / "many"
    for out, previews, first in ((none, 1, 1e9), (many, 7, 0)):
        monkeypatch.setattr("pp_cl.session.training.PREVIEWS", previews)
        monkeypatch.setattr("pp_cl.session.training.FIRST_PREVIEW", first)
        assert main(arguments(scene, out, **changes)) == 0
    names = [[p.name for p in sorted((run / "previews").iterdir())] for run in (none, many)]
    assert names[0] == ["step_000060.png"]
    assert names[1] == [f"step_{step:06d}.png" for step in (1, *range(9, 60, 9), 60)]
    assert checkpoint(none) == checkpoint(many)


def test_a_run_that_has_a_preview_needs_no_early_one(tmp_path, monkeypatch):
    scene, out = write_ball_scene(tmp_path / "ball"), tmp_path / "run"
    train_and_interrupt(scene, out, 35, monkeypatch)
    monkeypatch.setattr("pp_cl.session.training.FIRST_PREVIEW", 0)
    before = {p.name for p in (out / "previews").iterdir()}
    assert main(arguments(scene, out)) == 0
    after = {p.name for p in (out / "previews").iterdir()}
    assert after == before | {"step_000045.png", "step_000060.png"}
