import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.refused import failure
from support.runs import train_and_interrupt

from pp_cl.bench import frontier
from pp_cl.bench.frontier import Renderings, frame, visibility
from pp_cl.bench.plots import plot_frontier
from pp_cl.cli import main
from pp_cl.engine.raster.fragments import list_fragments
from pp_cl.evaluate import evaluate_run
from pp_cl.run import load


@pytest.fixture(scope="module")
def whole(finished):
    """The run's folder, and the measurements that --json wrote."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frontier, "SECONDS", 0.0)
        file = finished.parent / "b.json"
        words = ["--metrics", "psnr,ssim", "--json", str(file)]
        words += ["--plot", str(finished.parent / "b.png")]
        assert main(["bench", str(finished), *words]) == 0
    return finished, json.loads(file.read_text())


@pytest.fixture
def run(whole, dev, tmp_path):
    return load(shutil.copytree(whole[0], tmp_path / "run"), dev)


def of_knob(result, knob):
    rows = [row for row in result["rows"] if row["knob"] in (knob, "default")]
    return sorted(rows, key=lambda row: row["setting"][knob])


def test_each_setting_has_a_row(whole, dev, tmp_path):
    folder, result = whole
    rows = result["rows"]
    assert result["device"] == dev.name and result["views"] == 2
    assert len({json.dumps(row["setting"]) for row in rows}) == len(rows)
    for row in rows:
        assert 0 < row["ms_range"][0] <= row["ms"] <= row["ms_range"][1]
        assert 0 <= row["mean_err"] <= row["max_err"] <= 1 and row["psnr"] > 5
    (default,) = (row for row in rows if row["is_default"])
    mean = evaluate_run(load(folder, dev), out=tmp_path / "eval")["mean"]
    assert {name: default[name] for name in mean} == pytest.approx(mean)
    assert {row["knob"] for row in rows} >= {"early_stop", "samples", "points", "convolutions"}
    for row in (row for row in rows if row["knob"] == "convolutions"):
        assert row["max_err"] == pytest.approx(default["max_err"], abs=1e-5)
    assert (folder.parent / "b.png").read_bytes().startswith(b"\x89PNG")


def test_errors_fall_with_the_early_stop_and_with_more_points(whole):
    errors = [row["mean_err"] for row in of_knob(whole[1], "early_stop")]
    assert errors[0] == 0 and (np.diff(errors) > 0).all() and len(errors) == 6
    errors = [row["mean_err"] for row in of_knob(whole[1], "points")]
    assert (np.diff(errors) < 0).all() and len(errors) == 8


def test_the_table_names_default_and_frontier(whole, capsys):
    for row in whole[1]["rows"]:
        text = frontier.line(row)
        assert text.startswith(row["words"]) and f"{row['psnr']:.2f}" in text
        assert ("the default" in text) == row["is_default"]
        assert ("frontier" in text) == row["is_frontier"]


def test_a_frame_is_what_the_run_shows_to_a_camera_nearby(run):
    """Nearer than those of the training, whose depth range would cut the object."""
    far = run.cameras()[0]
    near = replace(far, pose=far.pose * [1, 1, 1, 0.5])
    np.testing.assert_array_equal(frame(run, near), run.render(near).colour)


def curve(axes, label):
    (points,) = (line.get_xydata().tolist() for line in axes.lines if line.get_label() == label)
    return points


def test_a_curve_for_each_knob_goes_through_the_default(whole, tmp_path):
    rows = whole[1]["rows"]
    left, right = plot_frontier(rows, str(tmp_path / "a.svg")).axes
    (default,) = ([row["ms"], row["psnr"]] for row in rows if row["is_default"])
    stops = [[row["ms"], row["psnr"]] for row in of_knob(whole[1], "early_stop")]
    assert curve(right, "early stop") == stops and default in stops
    assert curve(right, "default") == [default]
    front = sorted([row["ms"], row["psnr"]] for row in rows if row["is_frontier"])
    assert curve(right, "frontier") == front
    assert curve(left, "early stop")[0] == [stops[0][0], pytest.approx(4e-6)]  # 0 has no logarithm


def test_each_setting_changes_what_it_says(run, dev):
    camera = run.cameras("test")[0]
    renderings = Renderings(run)
    assert np.array_equal(frame(renderings.varied(renderings.default), camera), frame(run, camera))
    for setting in renderings.settings():
        varied = renderings.varied(setting)
        assert varied.config.raster.early_stop == setting.early_stop
        assert varied.renderer.supersampling**2 == setting.samples
        assert varied.model.net.variant == setting.convolutions
        assert varied.model.cloud.count == round(setting.points * run.model.cloud.count)


def test_visibility_is_the_sum_of_the_blend_weights(run):
    expected = np.zeros(run.model.cloud.count)
    for camera in run.cameras("train"):
        drawn = run.renderer.forward(camera, run.gamma, until="weights")
        listed = list_fragments(run.dev, drawn.points, drawn.pairs, drawn.weights)
        np.add.at(expected, listed.point, listed.weight)
    np.testing.assert_allclose(visibility(run), expected, rtol=1e-5)


def test_members_are_dropped_one_after_the_other(run, dev):
    other = run.varied(rows=np.arange(run.model.cloud.count // 2, dtype=np.uint32))
    renderings = Renderings(run.varied(others=[other]))
    assert renderings.choices["members"] == (2, 1)
    camera = run.cameras("test")[0]
    (alone,) = (s for s in renderings.settings() if s.members == 1)
    assert renderings.words(alone) == "1 of 2 members"
    assert np.array_equal(frame(renderings.varied(alone), camera), frame(run, camera))
    both = frame(renderings.varied(renderings.default), camera)
    np.testing.assert_array_equal(both, np.mean([frame(run, camera), frame(other, camera)], 0))


def test_only_finished_runs_are_measured(scene, tmp_path, monkeypatch):
    train_and_interrupt(scene, tmp_path / "run", 25, monkeypatch)
    message = f"{tmp_path / 'run'}: is at step 20 of 60; finish it first with `pp-cl train --out"
    assert message in failure("bench", tmp_path / "run")
