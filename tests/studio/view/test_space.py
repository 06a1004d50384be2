from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.scenes import ring_cameras

from pp_studio.view.space import Space

SPACE = Space(np.array([1e6, 2.0, -3.0]), 1e-3)
CAMERA = replace(ring_cameras(3, 48)[1].moved(SPACE.centre), height=40, cy=20)


@pytest.fixture
def frustum(served):
    return SPACE.add_frustum(served[0], "/one", CAMERA)


def seen(frustum, **changes):
    return SimpleNamespace(
        **{
            "wxyz": frustum.wxyz,
            "position": frustum.position,
            "fov": frustum.fov,
            "image_width": CAMERA.width,
            "image_height": CAMERA.height,
            **changes,
        }
    )


def test_a_camera_comes_back_as_it_went(frustum):
    camera = SPACE.camera(seen(frustum))
    np.testing.assert_allclose(camera.pose[:, :3], CAMERA.pose[:, :3], atol=1e-12)
    np.testing.assert_allclose(camera.eye, CAMERA.eye, rtol=1e-12)
    np.testing.assert_allclose(camera.fx, CAMERA.fx)
    assert (camera.width, camera.height, frustum.aspect) == (48, 40, 1.2)
    assert np.abs(SPACE.page(CAMERA.eye)).max() > 1000  # in units of radii


@pytest.mark.parametrize(
    "change",
    [
        {"wxyz": np.zeros(4)},
        {"wxyz": np.array([1, 0, 0, np.nan])},
        {"position": np.array([0, 1e300, 0])},
        {"fov": 0.0},
        {"fov": 4.0},
        {"image_height": -5},
        {"image_height": 10**9},
    ],
)
def test_numbers_that_are_no_camera_are_none(frustum, change):
    assert SPACE.camera(seen(frustum)) and SPACE.camera(seen(frustum, **change)) is None


def test_who_looks_through_a_camera_sees_its_axis(served):
    tab = served[0].initial_camera
    SPACE.look_through(CAMERA, tab)
    forward = (tab.look_at - tab.position) / np.linalg.norm(tab.look_at - tab.position)
    np.testing.assert_allclose(forward, CAMERA.pose[:, 2], atol=1e-9)
    assert abs(forward @ tab.look_at) < 1e-6 * np.linalg.norm(tab.position)
    np.testing.assert_allclose(np.tan(tab.fov / 2), 20 / CAMERA.fy)
