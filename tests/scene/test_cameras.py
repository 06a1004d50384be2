"""Where cameras look, and which direction they hold up."""

import numpy as np
import pytest
from support.ball_views import CENTRE, UP, ball_camera
from support.scenes import ring_cameras

from pp_cl.scene.camera import Camera
from pp_cl.scene.cameras import estimated_up, looked_at


def test_the_optical_axes_meet_where_the_cameras_look(rng):
    cameras = [ball_camera(CENTRE + 4 * d, CENTRE) for d in rng.normal(size=(7, 3))]
    np.testing.assert_allclose(looked_at(cameras), CENTRE, atol=1e-9)


def test_up_is_the_direction_that_all_horizons_are_level_to(rng):
    """Though the cameras look down, each by another angle, and lean by a degree or two."""
    up = np.array(UP) / np.linalg.norm(UP)
    directions = rng.normal(size=(40, 3))
    directions += (1.5 - directions @ up)[:, None] * up  # all from above
    cameras = [ball_camera(CENTRE + d, CENTRE) for d in directions]
    np.testing.assert_allclose(estimated_up(cameras), up, atol=1e-5)
    leaning = [_rolled(camera, np.radians(rng.uniform(-2, 2))) for camera in cameras]
    assert estimated_up(leaning) @ up > np.cos(np.radians(1))


def _rolled(camera, angle):
    """The camera, turned about its optical axis by radians."""
    c, s = np.cos(angle), np.sin(angle)
    pose = camera.pose.copy()
    pose[:, :2] = camera.pose[:, :2] @ [[c, -s], [s, c]]
    return Camera(pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)


@pytest.mark.parametrize("count", [1, 2])
def test_few_cameras_have_an_up_too(count):
    """One camera's x axis leaves a circle of directions, of which its own up is one."""
    cameras = ring_cameras(8, 32)[:count]
    up = estimated_up(cameras)
    assert np.linalg.norm(up) == pytest.approx(1)
    assert all(-camera.pose[:, 1] @ up > 0.7 for camera in cameras)


def test_cameras_upside_down_hold_down_up():
    cameras = [_rolled(camera, np.pi) for camera in ring_cameras(8, 32)]
    np.testing.assert_allclose(estimated_up(cameras), [0, 0, -1], atol=1e-5)
