from dataclasses import replace

import numpy as np
import pytest
from support.scenes import ring_cameras

from pp_cl.engine.grid import Grid
from pp_cl.files.rendered_view import RenderedView
from pp_studio.export import mesh
from pp_studio.export.mesh import fuse

RADIUS = 0.8
GRID = Grid((-1.0, -1.05, -1.1), 0.06, (34, 36, 38))


def ball_view(camera):
    """What a perfect run shows of a ball at the origin."""
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
    field = fuse(GRID, views)
    assert field.shape == GRID.dims[::-1] and np.abs(field).max() <= 1
    assert (field[radii() < RADIUS - GRID.voxel_size] < 0).all()
    # above and below, where the ring of cameras sees, and the grid's corners beside them
    assert np.mean(field[radii() > RADIUS + GRID.voxel_size] > 0) > 0.97


def test_slabs_change_nothing(views, monkeypatch):
    whole = fuse(GRID, views[:3])
    monkeypatch.setattr(mesh, "SLAB", 3000)
    assert np.array_equal(fuse(GRID, views[:3]), whole)


def test_a_ray_that_slips_through_hollows_nothing(views):
    camera, rendered = views[0]
    depth = rendered.median_depth.copy()
    depth[23:25, 23:25] = np.inf
    alpha = np.where(np.isfinite(depth), rendered.alpha, 0)
    broken = [(camera, replace(rendered, alpha=alpha, median_depth=depth)), *views[1:]]
    inside = radii() < RADIUS - 4 * GRID.voxel_size
    assert (fuse(GRID, broken)[inside] < 0).all()
    assert (fuse(GRID, broken, hidden=0.0)[inside] > 0).any()
