from dataclasses import replace

import numpy as np
import pytest
from support.ball_views import CENTRE, RADIUS, ball_camera, ball_view, ball_views

from pp_cl.errors import UserError
from pp_cl.scene.bounds import bounding_box
from pp_cl.scene.hull import build_grid


def test_the_box_holds_the_object_and_is_tight():
    box = bounding_box(ball_views())
    assert (box[0] <= CENTRE - RADIUS).all() and (box[1] >= CENTRE + RADIUS).all()
    assert (box[1] - box[0]).max() < 3.2 * RADIUS


@pytest.mark.large
def test_a_view_that_removes_everything_is_named(dev):
    views = ball_views()
    views[5].image[..., 3] = 0
    views[5].image[4:9, 4:9, 3] = 255
    with pytest.raises(UserError, match=r"^train/r_5\.png: .*check its alpha and its camera"):
        build_grid(dev, views, 100)


@pytest.mark.parametrize("flat", (False, True))
def test_wrong_axes_are_told(dev, flat):
    """flat: the cameras lie in one plane."""
    views = ball_views()
    if flat:
        angles = np.arange(8) * np.pi / 4
        views = [
            ball_view("r", ball_camera(CENTRE + [4 * np.cos(a), 4 * np.sin(a), 0], CENTRE))
            for a in angles
        ]
    views = [
        replace(v, stored_camera=replace(v.camera, pose=v.camera.pose * [1, -1, -1, 1]))
        for v in views
    ]
    with pytest.raises(UserError, match="leave no point.*camera-to-world"):
        build_grid(dev, views, 100)


def test_one_view_does_not_bound(dev):
    with pytest.raises(UserError, match="from several sides"):
        build_grid(dev, ball_views()[:1], 100)


def placed(place, scale=1.0):
    """The views with eyes scaled about the object's centre and moved so that it lies at `place`."""
    return [
        view.moved(place + scale * (view.camera.eye - CENTRE) - view.camera.eye)
        for view in ball_views()
    ]


def test_boxes_move_and_grow_with_the_cameras():
    box = bounding_box(ball_views()) - CENTRE
    for place, scale in ((CENTRE, 1e-8), (CENTRE, 1e12), (np.array([1e6, -2e6, 3.0]), 1.0)):
        rounding = 1e-9 * scale + 1e-15 * np.abs(place).max()
        moved = bounding_box(placed(place, scale)) - place
        np.testing.assert_allclose(moved, scale * box, rtol=0, atol=10 * rounding)


ALIKE = r"^train/r_0\.png and the 11 other training views: .* all in one place, \("


@pytest.mark.parametrize(
    "place, scale, told",
    [
        ((0, 0, 0), 0, ALIKE),
        ((1, -2, 3), 0, ALIKE),
        ((1e9, 0, 0), 0.01, ALIKE),
        ((0, 0, 0), 1e-14, "within .* scale their positions up"),
        ((0, 0, 0), 1e20, "float32 allows"),
    ],
)
def test_cameras_that_make_no_scene_are_told(dev, place, scale, told):
    with pytest.raises(UserError, match=told):
        build_grid(dev, placed(np.array(place), scale), 100)


def test_a_camera_that_is_much_too_far_is_named(dev):
    views = ball_views()
    views[4] = views[4].moved((0, -1e29, 0))
    with pytest.raises(UserError, match=r"^train/r_4\.png: its camera is 1e\+29 world units"):
        build_grid(dev, views, 100)
    views[4] = ball_views()[4].moved((0, -1e9, 0))
    with pytest.raises(UserError, match="bound the object|leave no point"):
        build_grid(dev, views, 100)


def test_pyramids_that_meet_in_a_point_have_no_box():
    views = [
        replace(view, stored_camera=replace(view.camera, fx=1e300, fy=1e300))
        for view in placed(np.zeros(3))
    ]
    with pytest.raises(UserError, match="bound the object"):
        bounding_box(views)
