from dataclasses import replace

import numpy as np
import pytest
from support.scenes import ring_cameras

from pp_cl.engine.camera import Camera
from pp_cl.engine.grid import Grid
from pp_cl.files.rendered_view import RenderedView
from pp_studio.export import fusion
from pp_studio.export.fusion import closed, fuse

RADIUS = 0.8
GRID = Grid((-1.0, -1.05, -1.1), 0.06, (34, 36, 38))


def ball_view(camera):
    """The view that a perfect run renders of a ball at the origin."""
    rays = camera.rays()
    a, b = (rays**2).sum(-1), rays @ camera.eye
    disc = b**2 - a * (camera.eye @ camera.eye - RADIUS**2)
    depth = np.where(disc > 0, (-b - np.sqrt(np.maximum(disc, 0))) / a, np.inf)
    return RenderedView(np.ones_like(rays), np.float32(disc > 0), depth, depth)


@pytest.fixture(scope="module")
def views():
    return [(camera, ball_view(camera)) for camera in ring_cameras(64, 48)]


def radii():
    return np.linalg.norm(GRID.lattice(), axis=1).reshape(GRID.dims[::-1])


def test_the_sign_is_that_of_the_ball(views):
    field = fuse(GRID, views).distances
    assert field.shape == GRID.dims[::-1] and np.abs(field).max() <= 1
    assert (field[radii() < RADIUS - GRID.voxel_size] < 0).all()
    # above and below the ball as well, which the ring sees, and at the grid's corners
    assert np.mean(field[radii() > RADIUS + GRID.voxel_size] > 0) > 0.97


def test_slabs_change_nothing(views, monkeypatch):
    whole = fuse(GRID, views[:3])
    monkeypatch.setattr(fusion, "SLAB", 3000)
    for field, other in zip(fuse(GRID, views[:3]), whole, strict=True):
        assert np.array_equal(field, other)


def test_a_ray_that_slips_through_hollows_nothing(views):
    camera, rendered = views[0]
    depth = rendered.median_depth.copy()
    depth[23:25, 23:25] = np.inf
    alpha = np.where(np.isfinite(depth), rendered.alpha, 0)
    broken = [(camera, replace(rendered, alpha=alpha, median_depth=depth)), *views[1:]]
    inside = radii() < RADIUS - 4 * GRID.voxel_size
    assert (fuse(GRID, broken).distances[inside] < 0).all()
    assert (fuse(GRID, broken, hidden=0.0).distances[inside] > 0).any()


def test_views_that_agree_do_not_scatter(views):
    """Scatter is only what a pixel spans of a slanted surface. If half of the views are off by 3
    voxels, it is half of these.
    """
    agreeing = fuse(GRID, views)
    surface = (np.abs(radii() - RADIUS) < GRID.voxel_size / 2) & (agreeing.near > 10)
    least = np.median(agreeing.scatter[surface])
    assert surface.sum() > 1000 and least < 1
    apart = [3 * GRID.voxel_size * (i % 2) for i in range(len(views))]
    moved = [
        (camera, replace(view, median_depth=view.median_depth + far))
        for (camera, view), far in zip(views, apart, strict=True)
    ]
    expected = np.hypot(1.5, least)
    assert np.median(fuse(GRID, moved).scatter[surface]) == pytest.approx(expected, abs=0.2)


def test_what_no_view_shows_is_closed_by_the_hull_of_the_points(views):
    """A ball seen only from above, whose points end at a plane below."""
    cameras = [
        Camera.look_at((x, y, 4), (0, 0, 0), (0, 1, 0), fx=130, width=100, height=100)
        for x, y in ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.5))
    ]
    fused = fuse(GRID, [(camera, ball_view(camera)) for camera in cameras])
    points = np.random.default_rng(0).normal(size=(2000, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    floor = -0.5 * RADIUS
    field = closed(GRID, fused, np.maximum(points, (-1, -1, floor)))
    z = GRID.lattice()[:, 2].reshape(GRID.dims[::-1])
    below, above = z < floor - GRID.voxel_size, z > floor + GRID.voxel_size
    within = radii() < RADIUS - 2 * GRID.voxel_size
    assert (fused.distances[below & within] < 0).any() and (field[below] > 0).all()
    assert (field[above & within] < 0).all()
    assert np.array_equal(field[fused.near >= 2], fused.distances[fused.near >= 2])
