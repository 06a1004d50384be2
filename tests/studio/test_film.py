"""Test how a film of a run changes from frame to frame."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from pp_cl.run import load
from pp_studio.camera_path import around
from pp_studio.commands.render import FPS, SECONDS
from pp_studio.large import render_large

FRAMES = 36  # of an orbit with visible flicker: 10 degrees apart
OPAQUE, NEAR = 0.95, 0.01  # least alpha of the surface; relative difference of depths at a place


@pytest.fixture(scope="module")
def run(runs, scene, session_device, tmp_path_factory):
    out = tmp_path_factory.mktemp("film") / "run"
    return load(runs.trained(out, scene, train__iterations=40), session_device)


def flicker(cameras, views):
    """Mean change, in 1/255, of places on the surface from the first of two frames to the second.
    The first frame's depth finds them.
    """
    (first, second), (before, after) = cameras, views
    rows, columns = np.nonzero(before.alpha >= OPAQUE)
    depth = before.median_depth[rows, columns, None].astype(float)
    places = depth * first.rays()[rows, columns] + first.eye
    x, y, z = ((places - second.eye) @ second.pose[:, :3]).T
    at = np.stack([second.fy * y / z + second.cy, second.fx * x / z + second.cx]) - 0.5
    most = [[second.height - 1], [second.width - 1]]
    nearest = tuple(np.rint(at).astype(int).clip(0, most))
    visible = np.abs(after.median_depth[nearest] / z - 1) < NEAR
    visible &= after.alpha[nearest] >= OPAQUE
    shown = [map_coordinates(after.colour[..., c], at[:, visible], order=1) for c in range(3)]
    return 255 * np.abs(before.colour[rows, columns][visible] - np.transpose(shown)).mean()


def test_a_film_flickers_half_as_much_as_one_of_ten_degrees_a_step(run):
    cameras, points = run.cameras("train"), run.model.positions()
    flickers = {}
    for frames in (FRAMES, FPS * SECONDS):
        pair = around("orbit", cameras, points, cameras[0].resized(96, 96), frames)[:2]
        flickers[frames] = flicker(pair, [render_large(run, camera) for camera in pair])
    assert FPS >= 24
    assert flickers[FPS * SECONDS] < 0.5 * flickers[FRAMES]
