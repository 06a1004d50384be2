"""The window of an image around all points."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.scene.window import ObjectWindow, hull_candidates

GRID = Grid((-1.0, -0.7, 0.2), 0.1, (13, 17, 7))
RADIUS, MARGIN = 0.075, 28


@pytest.fixture
def ids(rng):
    return np.sort(rng.choice(np.prod(GRID.dims), 300, replace=False))


def camera(eye, target=(-0.4, 0.1, 0.5), size=(90, 61)):
    return Camera.look_at(eye, target, fx=80.0, fy=95.0, width=size[0], height=size[1])


def test_all_vertices_of_the_convex_hull_are_candidates(ids):
    found = hull_candidates(GRID, ids)
    vertices = ids[ConvexHull(GRID.positions(ids)).vertices]
    assert set(vertices) <= set(found) <= set(ids) and len(found) < len(ids)


def test_candidates_of_a_full_grid_are_its_corners():
    found = hull_candidates(GRID, np.arange(np.prod(GRID.dims)))
    place = (GRID.positions(found) - GRID.origin) / GRID.edge
    assert len(found) == 8
    assert {*place.round().astype(int).ravel()} == {0, 12, 16, 6}


def test_no_ball_reaches_beyond_the_window(ids, rng):
    """Points of the balls' surfaces, by chance, are inside by the margin."""
    window = ObjectWindow(GRID, ids, RADIUS, MARGIN)
    for _ in range(20):
        eye = rng.normal(size=3)
        whole = camera(np.array([-0.4, 0.1, 0.5]) + eye / np.linalg.norm(eye) * rng.uniform(2, 9))
        shown, left, top = window.crop(whole)
        balls = rng.normal(size=(20_000, 3))
        balls = balls / np.linalg.norm(balls, axis=1, keepdims=True) * RADIUS
        balls += GRID.positions(rng.choice(ids, len(balls)))
        x, y, z = whole.pose[:, :3].T @ (balls - whole.eye).T
        x, y = whole.fx * x / z + whole.cx, whole.fy * y / z + whole.cy
        assert left % 4 == top % 4 == 0
        assert (shown.cx, shown.cy) == (whole.cx - left, whole.cy - top)
        for places, first, length, size in (
            (x, left, shown.width, whole.width),
            (y, top, shown.height, whole.height),
        ):
            assert first <= max(0, places.min() - MARGIN) and first + length <= size
            assert first + length >= min(size, places.max() + MARGIN)
            # and it is not much larger
            assert first >= min(places.min() - MARGIN - 8, size) or first == 0
            assert first + length <= max(places.max() + MARGIN + 9, 0) + 32


def test_all_of_the_image_where_the_eye_is_among_the_points(ids):
    whole = camera((-0.4, 0.0, 0.5), target=(-0.4, 0.8, 0.5))
    assert ObjectWindow(GRID, ids, RADIUS, MARGIN).crop(whole) == (whole, 0, 0)


@pytest.mark.parametrize("target", [(-0.4, 40.0, 0.5), (-0.4, -40.0, 0.5), (0, 0, 40)])
def test_a_few_pixels_where_no_point_is_in_the_image(ids, target):
    shown, left, top = ObjectWindow(GRID, ids, RADIUS, MARGIN).crop(camera((-9, 0.1, 0.5), target))
    assert 0 < shown.width <= 90 and 0 < shown.height <= 61 and min(left, top) >= 0
    assert shown.width * shown.height < 90 * 61 / 2
