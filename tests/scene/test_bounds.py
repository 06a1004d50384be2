"""The box that the masks allow, and what is said of masks and cameras that leave no point."""

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
    with pytest.raises(UserError, match=r"^train/r_5\.png: the mask is empty"):
        build_grid(dev, views, 100)
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


def test_views_from_one_place_do_not_bound(dev):
    with pytest.raises(UserError, match="from several sides"):
        build_grid(dev, ball_views()[:1], 100)
