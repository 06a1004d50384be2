"""Points to camera axes: which are culled, dropout and boxes."""

from dataclasses import replace

import numpy as np
import pytest

from pp_cl.device.buffers import Buffers
from pp_cl.raster import project
from pp_cl.raster.project import FOOTPRINTS
from pp_cl.reference import dense as oracle
from pp_cl.scene.grid import Grid
from pp_cl.selftest.points import make_camera, make_points

GRID = Grid((-1.1, -0.9, -0.7), 0.05, (45, 37, 29))


def project_grid(dev, camera, ids, **options):
    """(N, 4) positions in camera axes and distances of grid vertices."""
    points = project.project_grid(
        dev,
        Buffers(dev),
        "disc",
        dev.upload(camera.packed(oracle.DEPTH_RANGE)),
        dev.upload(GRID.packed()),
        point_id=dev.upload(ids, np.uint32),
        point_radius=dev.zeros((1,)),
        **options,
    )
    return points.point_camera.get()


def project_spheres(dev, camera, positions, radius, kind="soft", depth_range=oracle.DEPTH_RANGE):
    """((N, 4) camera positions, (N, 4) boxes)."""
    points = project.project_spheres(
        dev,
        Buffers(dev),
        kind,
        dev.upload(camera.packed(depth_range)),
        dev.upload(positions, np.float32),
        point_radius=dev.upload(np.atleast_1d(radius), np.float32),
    )
    return points.point_camera.get(), points.point_box.get()


def test_near_and_far_are_inclusive_and_the_radius_counts(dev):
    camera = replace(make_camera(focal=32.0), pose=np.eye(3, 4), fy=32.0)

    def kept(positions, radius):
        points, _ = project_spheres(dev, camera, positions, radius, depth_range=(2.0, 4.0))
        return (points[:, 3] > 0).tolist()

    positions = np.array([[0, 0, 2.0], [0, 0, 1.9999], [0, 0, 4.0], [0, 0, 4.0001]])
    assert kept(positions, 0.0) == [True, False, True, False]
    assert kept(positions + [0, 0, 0.5], 0.5) == [True, False, True, False]


def test_one_radius_means_all_alike(dev, rng):
    camera, positions = make_camera(), make_points(rng, 33)
    one, many = (
        project_spheres(dev, camera, positions, radius) for radius in (0.1, np.full(33, 0.1))
    )
    assert np.array_equal(one[0], many[0])
    assert np.array_equal(one[1], many[1])


def test_dropout_is_a_function_of_seed_and_id(dev):
    camera = make_camera()
    ids = np.arange(20000)
    dropped = project_grid(dev, camera, ids, dropout=0.15, seed=5)[:, 3] < 0
    assert abs(dropped.mean() - 0.15) < 0.01
    some = ids[::7][::-1]
    assert np.array_equal(
        project_grid(dev, camera, some, dropout=0.15, seed=5)[:, 3] < 0, dropped[some]
    )
    other = project_grid(dev, camera, ids, dropout=0.15, seed=6)[:, 3] < 0
    assert abs((other & dropped).mean() - 0.15**2) < 0.005
    assert (project_grid(dev, camera, ids, dropout=0.0, seed=5)[:, 3] > 0).all()


@pytest.mark.parametrize("kind", FOOTPRINTS)
def test_boxes_hold_the_hits_and_little_more(dev, rng, kind):
    camera = make_camera()
    n = 400
    positions, radius = make_points(rng, n) * 1.5, rng.uniform(0.001, 0.4, n)
    points, boxes = project_spheres(dev, camera, positions, radius, kind)
    boxes = boxes.astype(np.int64)
    c, t = oracle.camera_space(camera, positions), points[:, 3].astype(np.float64)
    reach = (
        radius
        if kind == "sphere"
        else np.maximum(radius, oracle.LEAST_RADIUS * oracle.pixel_width(camera, t))
    )
    expected = np.empty((n, 4))
    axes = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    for axis, (focal, centre, size) in enumerate(axes):
        alpha, theta = (
            np.arctan2(c[:, axis], c[:, 2]),
            np.arcsin(reach / np.hypot(c[:, axis], c[:, 2])),
        )
        low, high = (np.tan(alpha + sign * theta) * focal + centre - 0.5 for sign in (-1, 1))
        low, high = (
            (np.floor(low), np.ceil(high))
            if kind == "sphere"
            else (np.ceil(low - 0.01), np.floor(high + 0.01))
        )
        expected[:, axis], expected[:, 2 + axis] = np.maximum(low, 0), np.minimum(high, size - 1)
    empty = (t < 0) | (expected[:, 0] > expected[:, 2]) | (expected[:, 1] > expected[:, 3])
    assert 20 < empty.sum() < n - 100
    assert np.array_equal((boxes[:, 0] > boxes[:, 2]) | (boxes[:, 1] > boxes[:, 3]), empty)
    assert np.array_equal(boxes[~empty], expected[~empty])


def test_boxes_reach_all_over_the_image_beside_the_eye(dev):
    camera = replace(make_camera(), pose=np.eye(3, 4))
    points, boxes = project_spheres(
        dev, camera, np.array([[1.0, 0.0, 0.5]]), 0.6, "sphere", (0.1, 6.0)
    )
    assert points[0, 3] > 0
    assert boxes[0].tolist() == [0, 0, camera.width - 1, camera.height - 1]
