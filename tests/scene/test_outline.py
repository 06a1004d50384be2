import numpy as np
import pytest
from support.ball_views import CENTRE, RADIUS, ball_camera, ball_view

from pp_cl.engine.camera import Camera
from pp_cl.engine.grid import Grid
from pp_cl.scene.hull import silhouette
from pp_cl.scene.outline import outline


def ball_points(per_radius, shell=False):
    """(Grid, ids) of the vertices in the ball; shell: only its outer two layers."""
    voxel_size = RADIUS / per_radius
    n = 2 * per_radius + 3
    grid = Grid(tuple(CENTRE - voxel_size * (n - 1) / 2), voxel_size, (n, n, n))
    distance = np.linalg.norm(grid.lattice() - CENTRE, axis=1).reshape(n, n, n)
    inside = (distance <= RADIUS) & (distance > (RADIUS - 2 * voxel_size if shell else 0))
    return grid, grid.ids_of(inside)


@pytest.mark.parametrize("per_radius, shell", [(40, False), (12, False), (12, True), (6, False)])
def test_the_silhouette_is_that_of_the_ball_without_gaps(per_radius, shell):
    grid, ids = ball_points(per_radius, shell)
    camera = ball_camera(CENTRE + np.array([3.0, 2.0, 1.0]), CENTRE, size=(96, 80))
    mask = silhouette(grid, ids, camera)
    truth = ball_view("ball", camera).image[..., 3] > 0
    assert mask.shape == (80, 96)
    wrong = mask != truth
    assert wrong.sum() < 0.12 * truth.sum()
    y, x = np.nonzero(wrong)  # pixels are wrong only along the border, within the points' spacing
    radius = np.sqrt(truth.sum() / np.pi)
    off = np.abs(np.hypot(x + 0.5 - camera.cx, y + 0.5 - camera.cy) - radius)
    assert off.max() < radius / per_radius + 2.5


def test_the_outline_is_a_thin_ring():
    grid, ids = ball_points(20)
    camera = ball_camera(CENTRE + np.array([4.0, 0.0, 1.0]), CENTRE, size=(96, 96))
    ring, inside = outline(grid, ids, camera), silhouette(grid, ids, camera)
    length = 2 * np.pi * np.sqrt(inside.sum() / np.pi)
    assert 1.5 * length < ring.sum() < 3.5 * length
    assert not ring[48, 48] and not ring[0].any()


def test_points_behind_the_camera_and_outside_the_image_are_not_drawn():
    grid, ids = ball_points(6)
    away = Camera.look_at(CENTRE + [3.0, 0, 0], CENTRE + [9.0, 0, 0], fx=90, width=64, height=64)
    assert not silhouette(grid, ids, away).any()
    beside = ball_camera(CENTRE + [3.0, 0, 0], CENTRE + [0, 9.0, 0])
    assert not outline(grid, ids, beside).any()


def test_a_cut_off_object_has_no_outline_along_the_border():
    """The camera is so close that the ball fills the image."""
    grid, ids = ball_points(20)
    camera = ball_camera(CENTRE + [1.2, 0, 0], CENTRE)
    assert silhouette(grid, ids, camera).all() and not outline(grid, ids, camera).any()
