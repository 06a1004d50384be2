"""What a run shows to a camera, and how it follows its checkpoint."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from support.scenes import ring_cameras
from support.viewing import asking, decoded

from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.run import load_run
from pp_cl.view.live_run import (
    LiveRun,
    draft_factor,
    hits_per_pixel,
    most_opaque,
    nearest_view,
)
from pp_cl.view.messages import SHOWN, read_request


def drawn(live, camera, **changes):
    """(facts, image) that a LiveRun draws."""
    facts, data = live.draw(read_request(json.dumps(asking(camera, **changes))))
    return facts, decoded(data)


@pytest.fixture
def live(dev, trained):
    """The small run, loaded."""
    live = LiveRun(dev, trained)
    assert live.refresh()
    return live


def test_a_snapshot_is_what_the_run_renders(dev, live, trained):
    camera = ring_cameras(3, 48)[2]
    facts, image = drawn(live, camera, kind="snapshot")
    run = load_run(dev, trained)
    np.testing.assert_array_equal(image, to_8bit(run.render(camera).colour))
    assert facts["mime"] == "image/png" and facts["camera"] == asking(camera)["camera"]


def test_every_quantity_is_another_picture(live):
    camera = ring_cameras(3, 48)[2]
    images = [drawn(live, camera, show=show, kind="snapshot") for show in SHOWN]
    sizes = {image.shape for _, image in images}
    assert sizes == {(48, 48, 3), (24, 24, 3)}  # a training view has its own camera
    assert len({image.tobytes() for _, image in images}) == len(SHOWN)
    assert [facts["view"] is not None for facts, _ in images] == [False] * 5 + [True] * 2
    scales = {facts["show"]: facts["scale"] for facts, _ in images if facts["scale"]}
    assert set(scales) == {"depth", "hits"}
    assert 0 < scales["depth"][0] < 4 < scales["depth"][1]


@pytest.mark.parametrize("change", [{"early_stop": 0.5}, {"kept": 0.3}, {"exposure": -1}])
def test_every_slider_changes_the_picture_and_spoils_nothing(live, change):
    camera = ring_cameras(3, 48)[2]
    _, before = drawn(live, camera)
    _, changed = drawn(live, camera, **change)
    _, after = drawn(live, camera)
    assert np.abs(changed - before).max() > 3
    np.testing.assert_array_equal(after, before)


def test_the_error_is_that_of_the_nearest_view_from_its_own_camera(dev, live, trained):
    run = load_run(dev, trained)
    view = run.scene("train").splits["train"][5]
    near = replace(view.camera, pose=view.camera.pose + 1e-3 * np.eye(3, 4, 3))
    facts, error = drawn(live, near, show="error", kind="snapshot")
    _, photograph = drawn(live, near, show="photograph", kind="snapshot")
    assert facts["view"] == 5
    np.testing.assert_allclose(facts["camera"]["fl_x"], view.camera.fx)
    rendering = to_8bit(run.render(view.camera).colour).astype(int)
    expected = np.minimum(4 * np.abs(rendering - photograph), 255)
    assert np.abs(error - expected).max() <= 5  # both are rounded, four times
    assert photograph.min() < 250 and error.max() > 5


def test_a_draft_has_a_quarter_of_the_resolution(live):
    camera = ring_cameras(1, 96)[0]
    facts, image = drawn(live, camera, draft=True)
    assert image.shape == (24, 24, 3) and facts["camera"]["fl_x"] == camera.fx / 4
    assert draft_factor(replace(camera, width=40)) == 2
    assert draft_factor(replace(camera, width=17)) == 1


def test_hits_are_those_of_the_pairs(dev, live, trained):
    run = load_run(dev, trained)
    camera = replace(ring_cameras(3, 48)[2], width=45, height=43)  # is padded
    hits = hits_per_pixel(run.renderer, camera, run.gamma)
    assert hits.shape == (43, 45)
    wider, left, top = camera.padded(4)
    all_hits = hits_per_pixel(run.renderer, wider, run.gamma)
    np.testing.assert_array_equal(hits, all_hits[top : top + 43, left : left + 45])
    assert all_hits.sum() == run.renderer.forward(wider, run.gamma, until="weights").pairs.total
    fewer = drawn(live, camera, show="hits", kept=0.2)[0]["scale"]
    assert 0 < fewer[1] < hits.max()


def test_the_most_opaque_points_are_kept(dev, trained):
    run = load_run(dev, trained)
    opacity, ids = run.model.cloud.opacity.get(), run.model.cloud.ids.get()
    fewer = most_opaque(run.model, run.model.net, 0.25)
    kept = fewer.cloud.opacity.get()
    assert len(kept) == round(0.25 * len(opacity))
    assert kept.min() >= np.sort(opacity)[-len(kept)]
    rows = np.searchsorted(ids, fewer.cloud.ids.get())
    for whole, part in zip(run.model.cloud.sh, fewer.cloud.sh, strict=True):
        np.testing.assert_array_equal(part.get(), whole.get()[rows])
    np.testing.assert_array_equal(run.model.cloud.opacity.get(), opacity)
    assert most_opaque(run.model, run.model.net, 1e-9).cloud.count == 1


def test_a_new_checkpoint_is_taken_up_and_a_broken_one_is_not(dev, copied):
    live = LiveRun(dev, copied)
    whole = (copied / "checkpoint.npz").read_bytes()
    (copied / "checkpoint.npz").unlink()
    assert not live.refresh() and "waiting" in live.waiting and live.surroundings() is None
    with pytest.raises(UserError, match="waiting"):
        drawn(live, ring_cameras(1, 48)[0])
    (copied / "checkpoint.npz").write_bytes(whole[:-100])
    assert live.refresh() and "corrupt" in live.waiting
    (copied / "checkpoint.npz").write_bytes(whole)
    assert live.refresh() and live.waiting is None and live.loads == 1
    assert not live.refresh()
    os.utime(copied / "checkpoint.npz", ns=(1, 1))
    assert live.refresh() and live.loads == 2
    (copied / "checkpoint.npz").write_bytes(whole[:-100])
    assert live.refresh() and "corrupt" in live.notice and live.loads == 2
    drawn(live, ring_cameras(1, 48)[0])  # the last good one


def test_a_run_whose_photographs_are_gone_is_still_shown(dev, copied):
    config = json.loads((copied / "config.json").read_text())
    config["scene"]["path"] = "/nowhere/at/all"
    (copied / "config.json").write_text(json.dumps(config))
    live = LiveRun(dev, copied)
    assert live.refresh() and "/nowhere/at/all" in live.notice
    around = live.surroundings()
    cameras = load_run(dev, copied).cameras("train")
    assert [one["camera"] for one in around["views"]] == [asking(c)["camera"] for c in cameras]
    assert around["camera"] == around["views"][0]["camera"]
    _, image = drawn(live, around["camera"])
    assert (image < 200).any()
    with pytest.raises(UserError, match="no photographs"):
        drawn(live, around["camera"], show="error")


def test_surroundings_hold_the_first_training_camera_and_what_is_up(dev, live, trained):
    around = live.surroundings()
    first = load_run(dev, trained).cameras("train")[0]
    assert around["camera"] == around["views"][0]["camera"] == asking(first)["camera"]
    np.testing.assert_allclose(np.linalg.norm(around["up"]), 1)
    np.testing.assert_allclose(around["up"], [0, 0, 1], atol=0.1)
    assert np.linalg.norm(around["centre"]) < 0.3 and 0.6 < around["radius"] < 2


def test_the_nearest_view_counts_place_and_direction():
    cameras, centre = ring_cameras(6, 48), np.zeros(3)
    assert [nearest_view(cameras, camera, centre) for camera in cameras] == list(range(6))
    away = replace(cameras[2], pose=cameras[2].pose * [-1, 1, -1, 1])  # looks outwards
    assert nearest_view([away, cameras[2]], cameras[2], centre) == 1


def test_rows_of_the_log_that_are_no_rows_are_left_out(dev, copied):
    lines = (copied / "log.jsonl").read_text().splitlines(keepends=True)
    live = LiveRun(dev, copied)
    rows = live.new_rows()
    assert len(rows) == len(lines) - 1 and len(rows[0]) == 3  # the last says "finished"
    assert live.new_rows() is None
    (copied / "log.jsonl").write_text(lines[0] + lines[1][:9])
    assert live.new_rows() == rows[:1]
    (copied / "log.jsonl").unlink()
    if hasattr(os, "mkfifo"):
        os.mkfifo(copied / "log.jsonl")  # is not waited for
    assert not live.new_rows()
