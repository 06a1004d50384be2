"""Trainings that refine their grid on the way."""

import json

import pytest
from support.runs import arguments, train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main


@pytest.mark.parametrize("share, stops", [(0.3, (12, 33)), (0.9, (52, 57))])
def test_a_refined_run_resumes_to_the_same_bytes(tmp_path, monkeypatch, share, stops):
    """Stopped before and after the refinement, which may come after the averages' beginning."""
    scene = write_ball_scene(tmp_path / "ball")
    changes = {"train__refine_at": f"{share},1", "points__count": 300, "train__prune_looks": 4}
    changes["downscale"] = 1
    assert main(arguments(scene, tmp_path / "whole", **changes)) == 0
    whole = (tmp_path / "whole" / "checkpoint.npz").read_bytes()
    log = (tmp_path / "whole" / "log.jsonl").read_text().splitlines()
    points = {row["step"]: row["points"] for row in map(json.loads, log[:-1])}
    after = round(60 * share) // 5 * 5 + 5
    assert points[after] > 4 * points[after - 5]
    for steps in stops:
        out = tmp_path / str(steps)
        train_and_interrupt(scene, out, steps, monkeypatch, **changes)
        assert main(arguments(scene, out, **changes)) == 0
        assert (out / "checkpoint.npz").read_bytes() == whole


def test_images_too_small_to_halve_are_one_line(tmp_path, capsys):
    scene = write_ball_scene(tmp_path / "ball")
    words = arguments(scene, tmp_path / "small", train__refine_at="0.3,0.6", train__prune_looks=4)
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "train.refine_at halves the images 2 times" in error and error.count("\n") == 1
