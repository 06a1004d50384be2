from dataclasses import replace

import numpy as np
import pytest

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.grid import Grid
from pp_cl.engine.raster import project
from pp_cl.engine.raster.project import project_grid
from pp_cl.reference import dense
from pp_cl.selftest.points import PairedPoints, make_camera, make_points, some_ids


def test_near_and_far_are_inclusive_and_the_radius_counts(dev):
    camera = replace(make_camera(focal=32.0), pose=np.eye(3, 4), fy=32.0)

    def drawn(positions, radius):
        scene = PairedPoints(dev, camera, positions, radius, depth_range=(2.0, 4.0))
        return np.isin(np.arange(4), scene.seen).tolist()

    positions = np.array([[0, 0, 2.0], [0, 0, 1.9999], [0, 0, 4.0], [0, 0, 4.0001]])
    assert drawn(positions, 0.0) == [True, False, True, False]
    assert drawn(positions + [0, 0, 0.5], 0.5) == [True, False, True, False]


@pytest.mark.parametrize("kind", ["disc", "soft"])
def test_what_whole_bricks_miss_no_point_of_them_covers(dev, rng, monkeypatch, kind):
    grid = Grid((-1.1, -0.9, -0.7), 0.05, (45, 37, 29))
    ids = some_ids(rng, grid, 12_000)
    offset = rng.choice([-0.5, 0.5], (len(ids), 4)).astype(np.float32)
    whole = make_camera(320, 240, 400.0)

    def counts(camera):
        return project_grid(
            dev,
            Buffers(dev),
            kind,
            dev.upload(camera.packed(dense.DEPTH_RANGE)),
            dev.upload(grid.packed()),
            point_id=dev.upload(ids),
            cloud_offset=dev.upload(offset),
            opacity=dev.zeros((len(ids), 9)),
            radius=0.04,
        ).point_count.get()

    crops = [whole.crop(x, y, 32, 32) for x in range(0, 320, 32) for y in range(0, 240, 24)]
    point_counts = [counts(crop) for crop in crops]
    assert 0.01 < np.mean([(count > 0).mean() for count in point_counts]) < 0.2
    monkeypatch.setattr(project, "MOST_OFFSET", 1e6)  # bricks reach everywhere
    assert all(
        np.array_equal(count, counts(crop)) for count, crop in zip(point_counts, crops, strict=True)
    )
    monkeypatch.setattr(project, "MOST_OFFSET", -3.5)  # bricks end before their middle
    culls = dev.is_cpu  # GPUs judge each point alone
    assert (
        any((count != counts(crop)).any() for count, crop in zip(point_counts, crops, strict=True))
        == culls
    )


@pytest.mark.parametrize("deviation, bound", [(0.02, 0.1), (0.1, 0.01), (0.4, 0.01)])
def test_a_pixel_of_samples_is_nearly_the_mean_of_a_viewers(dev, rng, deviation, bound):
    camera = replace(make_camera(30, 30), samples=3.0)
    viewer = replace(camera.resized(90, 90), samples=1.0)
    for position in make_points(rng, 20)[:, None]:
        scene = PairedPoints(dev, camera, position, deviation, kind="gaussian")
        exact = dense.geometry(viewer, position, deviation, "gaussian")
        drawn = np.where(exact["fragment"], exact["falloff"], 0).reshape(30, 3, 30, 3)
        falloff = scene.geometry()["falloff"].reshape(30, 30)
        assert falloff.max() > 0.1
        np.testing.assert_allclose(falloff, drawn.mean((1, 3)), atol=bound)
