from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.guarded import large

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.raster.pairs import MOST_PAIRS, capacity_needed
from pp_cl.engine.raster.project import TILE
from pp_cl.reference import dense as oracle
from pp_cl.selftest.points import PairedPoints, find_all_pairs, make_camera, make_points


@pytest.mark.parametrize(
    "lengths",
    [
        (0, 1, 23, 24, 25, 63, 64, 65, 128, 129, 4095, 4096, 4097, 9000),
        large((70, 262_144, 262_145, 4096, 300_000)),
    ],
)
def test_lists_of_all_lengths_side_by_side_are_sorted(dev, rng, lengths):
    """Lengths are around those from which on CPUs sort otherwise and GPUs need another pass."""
    width = len(lengths) * TILE
    camera = replace(make_camera(width, 1), fx=400.0, fy=400.0, cx=width / 2, cy=0.5)
    tile = rng.permutation(np.repeat(np.arange(len(lengths)), lengths))
    along = oracle.rays(camera)[TILE * tile + TILE // 2] @ camera.pose[:, :3].T
    depths = rng.uniform(2.2, 5.8, (len(tile), 1))
    depths[::3] = 4  # many are equal, or nearly so
    pairs = PairedPoints(dev, camera, camera.eye + depths * along, 1e-4, kind="disc").pairs
    offsets, keys = pairs.tile_offset.get().astype(np.int64), pairs.pair_key.get()[: pairs.total]
    assert tuple(np.diff(offsets)) == lengths
    assert np.array_equal(tile[keys & 0xFFFFFFFF], np.repeat(np.arange(len(lengths)), lengths))
    ends = np.isin(np.arange(1, len(keys)), offsets)
    assert (keys[1:] > keys[:-1])[~ends].all()


def bits(pairs):
    keys = pairs.pair_key.get()[: pairs.total]
    return [keys, pairs.point_offset.get(), pairs.tile_offset.get()]


def test_more_capacity_is_a_number_of_the_kernels():
    for total, expected in ((900, 1000), (1001, 1251), (3_500_000_000, MOST_PAIRS)):
        assert capacity_needed(SimpleNamespace(capacity=1000, total=total)) == expected


def test_buffers_serve_views_of_any_size(dev, rng):
    few, many = make_points(rng, 31), make_points(rng, 257)
    buffers = Buffers(dev)
    for positions, size in ((many, (33, 31)), (few, (5, 9)), (many[:1], (1, 1)), (many, (33, 31))):
        view = replace(make_camera(*size), cx=size[0] / 2, cy=size[1] / 2)
        scene = PairedPoints(dev, view, positions, 0.3)
        used = find_all_pairs(dev, buffers, scene.projected, scene.shape)
        assert all(map(np.array_equal, bits(scene.pairs), bits(used)))


@pytest.mark.large
def test_bits_do_not_depend_on_compute_units(dev, rng, monkeypatch):
    camera = replace(make_camera(400, 400), fx=300.0, fy=300.0, cx=200.0, cy=200.0)
    scene = PairedPoints(dev, camera, make_points(rng, 30_000), 0.1, kind="disc")
    for units in (1, 3, 16, 1000):
        monkeypatch.setitem(dev.info, "compute_units", units)
        pairs = find_all_pairs(dev, Buffers(dev), scene.projected, scene.shape)
        assert all(map(np.array_equal, bits(scene.pairs), bits(pairs)))
