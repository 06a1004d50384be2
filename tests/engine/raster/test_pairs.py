from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.guarded import large

from pp_cl.bench.spheres import find_all_pairs
from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.raster.footprint import FOOTPRINTS
from pp_cl.engine.raster.pairs import MOST_PAIRS, capacity_needed, find_pairs
from pp_cl.reference import dense as oracle
from pp_cl.selftest.points import PairedPoints, make_camera, make_points


def by_point(pairs):
    offsets = pairs.point_offset.get()[1:-1]
    falloff = pairs.pair_point_falloff.get()[: pairs.total, 1].view(np.float32)
    pixels = np.split(pairs.pair_pixel.get()[: pairs.total], offsets)
    return list(zip(pixels, np.split(falloff, offsets), strict=True))


@pytest.mark.parametrize("kind", FOOTPRINTS)
def test_fragments_that_were_counted_otherwise_stay_within_their_point(dev, rng, kind):
    """A compiler may round one way when fragments are counted, another when they are written: the
    pairs of other points must not change, and no slot may stay undefined.
    """
    camera, n = make_camera(), 300
    scene = PairedPoints(dev, camera, make_points(rng, n), 0.1, kind=kind)
    counts = scene.projected.point_count.get().astype(np.int64)
    change = np.where(counts > 2, rng.choice([-2, -1, 0, 0, 1, 2], n), 0)
    assert {*change} == {-2, -1, 0, 1, 2}
    planted = replace(scene.projected, point_count=dev.upload(counts + change, np.uint32))
    pairs = find_all_pairs(dev, Buffers(dev), planted, scene.shape)
    assert pairs.total == (counts + change).sum()
    for before, after, difference in zip(
        by_point(scene.pairs), by_point(pairs), change, strict=True
    ):
        both = min(len(before[0]), len(after[0]))
        assert len(after[0]) - len(before[0]) == difference
        assert all(np.array_equal(a[:both], b[:both]) for a, b in zip(before, after, strict=True))
        assert (after[1][both:] == 0).all()
    pixels, keys = pairs.pair_pixel.get()[: pairs.total], pairs.pair_key.get()[: pairs.total]
    assert np.array_equal(np.sort(keys & 0xFFFFFFFF), np.arange(pairs.total))
    listed = np.diff(pairs.pixel_offset.get().astype(np.int64))
    assert np.array_equal(listed, np.bincount(pixels, minlength=len(listed)))


@pytest.mark.parametrize(
    "lengths",
    [
        (0, 1, 63, 64, 65, 128, 129, 4095, 4096, 4097, 9000),
        large((70, 262_144, 262_145, 4096, 300_000)),
    ],
)
def test_lists_of_all_lengths_side_by_side_are_sorted(dev, rng, lengths):
    """Lengths are around those from which on GPUs need another merge pass."""
    camera = replace(make_camera(len(lengths), 1), fx=20.0, fy=20.0, cx=len(lengths) / 2, cy=0.5)
    pixel = rng.permutation(np.repeat(np.arange(len(lengths)), lengths))
    along = oracle.rays(camera)[pixel] @ camera.pose[:, :3].T
    positions = camera.eye + rng.uniform(2.2, 5.8, (len(pixel), 1)) * along
    pairs = PairedPoints(dev, camera, positions, 1e-4, kind="disc").pairs
    offsets, keys = pairs.pixel_offset.get().astype(np.int64), pairs.pair_key.get()[: pairs.total]
    assert tuple(np.diff(offsets)) == lengths
    pixels = pairs.pair_pixel.get()[(keys & 0xFFFFFFFF).astype(np.int64)]
    assert np.array_equal(pixels, np.repeat(np.arange(len(lengths)), lengths))
    assert len(np.unique(keys & 0xFFFFFFFF)) == pairs.total
    assert (keys[1:] > keys[:-1])[pixels[1:] == pixels[:-1]].all()


def bits(pairs):
    names = ("pair_pixel", "pair_point_falloff", "pair_key")
    arrays = [getattr(pairs, name).get()[: pairs.total] for name in names]
    return [*arrays, pairs.point_offset.get(), pairs.pixel_offset.get()]


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
        pairs = find_pairs(dev, Buffers(dev), scene.projected, scene.shape, scene.pairs.total)
        pairs.read_count(dev)
        assert all(map(np.array_equal, bits(scene.pairs), bits(pairs)))
