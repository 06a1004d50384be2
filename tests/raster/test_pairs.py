"""Hits: which there are, how close and deep they are, and in which order they lie."""

from dataclasses import replace

import numpy as np
import pytest
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES, large

from pp_cl.raster.pairs import PairBuilder
from pp_cl.raster.project import KINDS, Footprint
from pp_cl.reference import dense as oracle
from pp_cl.selftest.points import PairedPoints, make_camera, make_points

BAND = 1e-4  # pixels beside the edge of a footprint where rounding may decide


def check(scene, expected):
    """Compare a scene's pairs with oracle.geometry: hits, closeness, depth, and all orders."""
    pairs, total = scene.pairs, scene.pairs.total
    hits = scene.hits()
    clear = expected["margin"] > BAND
    assert np.array_equal(hits[clear], expected["hit"][clear])
    assert hits.sum() == total and (~clear).mean() < 0.01

    points, pixels = scene.pair_points(), pairs.pair_pixel.get()[:total].astype(np.int64)
    source = pairs.pair_point_closeness.get()[:total]
    assert np.array_equal(source[:, 0], points)
    assert (
        relative_error(source[:, 1].view(np.float32), expected["closeness"][points, pixels]) < 1e-4
    )

    offsets, keys = pairs.pixel_offset.get().astype(np.int64), pairs.pair_key.get()[:total]
    assert np.array_equal(np.diff(offsets), hits.sum(axis=0))
    pair = (keys & 0xFFFFFFFF).astype(np.int64)
    depth = (keys >> 32).astype(np.uint32).view(np.float32)
    assert np.array_equal(np.sort(pair), np.arange(total))
    assert np.array_equal(pixels[pair], np.repeat(np.arange(len(offsets) - 1), np.diff(offsets)))
    # at the rim of a sphere it is steep
    assert relative_error(depth, expected["depth"][points[pair], pixels[pair]]) < 1e-3
    inner = pixels[pair][1:] == pixels[pair][:-1]
    assert (keys[1:] > keys[:-1])[inner].all()
    assert np.array_equal(scene.seen, np.flatnonzero(hits.any(axis=1)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("radius", [1e-3, 0.08, 0.5])
def test_equal_radii(dev, rng, kind, radius):
    camera, positions = make_camera(), make_points(rng, 300)
    check(
        PairedPoints(dev, camera, positions, radius, kind=kind),
        oracle.geometry(camera, positions, radius, kind),
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_radii_of_all_sizes(dev, rng, kind, n):
    camera, positions = replace(make_camera(33, 31), fy=26.0), make_points(rng, n)
    radius = np.float32(10.0 ** rng.uniform(-3, 0, n))
    check(
        PairedPoints(dev, camera, positions, radius, kind=kind),
        oracle.geometry(camera, positions, radius, kind),
    )


def by_point(pairs):
    """[(pixels, closeness)] of each point."""
    offsets = pairs.point_offset.get()[1:-1]
    closeness = pairs.pair_point_closeness.get()[: pairs.total, 1].view(np.float32)
    pixels = np.split(pairs.pair_pixel.get()[: pairs.total], offsets)
    return list(zip(pixels, np.split(closeness, offsets), strict=True))


@pytest.mark.parametrize("kind", KINDS)
def test_hits_that_were_counted_otherwise_stay_within_their_point(dev, rng, kind):
    """As where a compiler rounds in one way where hits are counted, in another where they are
    written: all other points' pairs are what they would be, and no slot is left undefined.
    """
    camera, n = make_camera(), 300
    scene = PairedPoints(dev, camera, make_points(rng, n), 0.1, kind=kind)
    counts = scene.projected.point_count.get().astype(np.int64)
    change = np.where(counts > 2, rng.choice([-2, -1, 0, 0, 1, 2], n), 0)
    assert {*change} == {-2, -1, 0, 1, 2}
    planted = replace(scene.projected, point_count=dev.upload(counts + change, np.uint32))
    pairs = PairBuilder(dev, Footprint(kind)).build(planted, scene.shape)
    assert pairs.total == (counts + change).sum()
    for one, other, difference in zip(by_point(scene.pairs), by_point(pairs), change, strict=True):
        both = min(len(one[0]), len(other[0]))
        assert len(other[0]) - len(one[0]) == difference
        assert all(np.array_equal(a[:both], b[:both]) for a, b in zip(one, other, strict=True))
        assert (other[1][both:] == 0).all()
    pixels, keys = pairs.pair_pixel.get()[: pairs.total], pairs.pair_key.get()[: pairs.total]
    assert np.array_equal(np.sort(keys & 0xFFFFFFFF), np.arange(pairs.total))
    listed = np.diff(pairs.pixel_offset.get().astype(np.int64))
    assert np.array_equal(listed, np.bincount(pixels, minlength=len(listed)))


def test_a_crop_sees_the_same_hits(dev, rng):
    camera, positions = make_camera(40, 36), make_points(rng, 300)
    whole = PairedPoints(dev, camera, positions, 0.1).hits().reshape(-1, 36, 40)
    crop = PairedPoints(dev, camera.crop(11, 7, 13, 17), positions, 0.1).hits().reshape(-1, 17, 13)
    assert np.array_equal(crop, whole[:, 7:24, 11:24])
    assert crop.any()


def test_every_visible_point_hits_a_pixel(dev, rng):
    camera = replace(make_camera(40, 36), fy=30.0)
    slopes = rng.uniform(-0.3, 0.3, (2000, 2))
    positions = camera.eye + 4 * np.column_stack([slopes, np.ones(2000)]) @ camera.pose[:, :3].T
    assert len(PairedPoints(dev, camera, positions, 1e-3, kind="disc").seen) == 2000


@pytest.mark.parametrize("n", [63, 64, 65, 128, 129, 1000, large(100_000)])
def test_lists_of_any_length_are_sorted(dev, rng, n):
    camera = replace(make_camera(1, 1), pose=np.eye(3, 4), cx=0.5, cy=0.5)
    positions = np.zeros((n, 3))
    positions[:, 2] = np.round(rng.uniform(2.2, 5.9, n), 3)  # many equal depths
    pairs = PairedPoints(dev, camera, positions, 0.1).pairs
    assert pairs.total == n
    expected = np.argsort(positions[:, 2].astype(np.float32), kind="stable")
    assert np.array_equal(pairs.pair_key.get()[:n] & 0xFFFFFFFF, expected)


@pytest.mark.parametrize(
    "lengths", [(0, 1, 4095, 4096, 4097, 65, 9000), large((70, 262_144, 262_145, 4096, 300_000))]
)
def test_lists_of_all_lengths_side_by_side_are_sorted(dev, rng, lengths):
    """About the lengths at which GPUs merge in one pass more."""
    camera = replace(make_camera(len(lengths), 1), fx=5.0, fy=5.0, cx=len(lengths) / 2, cy=0.5)
    pixel = rng.permutation(np.repeat(np.arange(len(lengths)), lengths))
    along = oracle.rays(camera)[pixel] @ camera.pose[:, :3].T
    positions = camera.eye + rng.uniform(2.2, 5.8, (len(pixel), 1)) * along
    pairs = PairedPoints(dev, camera, positions, 1e-4, kind="disc").pairs
    offsets, keys = pairs.pixel_offset.get().astype(np.int64), pairs.pair_key.get()[: pairs.total]
    assert tuple(np.diff(offsets)) == lengths
    found = pairs.pair_pixel.get()[(keys & 0xFFFFFFFF).astype(np.int64)]
    assert np.array_equal(found, np.repeat(np.arange(len(lengths)), lengths))
    assert len(np.unique(keys & 0xFFFFFFFF)) == pairs.total
    assert (keys[1:] > keys[:-1])[found[1:] == found[:-1]].all()


def test_buffers_serve_views_of_any_size(dev, rng):
    few, many = make_points(rng, 31), make_points(rng, 257)
    builder = PairBuilder(dev, Footprint("soft"))
    for positions, size in ((many, (33, 31)), (few, (5, 9)), (many[:1], (1, 1)), (many, (33, 31))):
        view = replace(make_camera(*size), cx=size[0] / 2, cy=size[1] / 2)
        other = PairedPoints(dev, view, positions, 0.3)
        other.pairs = builder.build(other.projected, other.shape)
        check(other, oracle.geometry(view, positions, 0.3, "soft"))


def test_two_builds_give_the_same_bits(dev, rng):
    camera, positions = make_camera(40, 36), make_points(rng, 5000)
    first, second = (PairedPoints(dev, camera, positions, 0.15).pairs for _ in range(2))
    total = first.total
    for name in ("pair_pixel", "pair_point_closeness", "pair_key"):
        assert np.array_equal(
            getattr(first, name).get()[:total], getattr(second, name).get()[:total]
        ), name
    assert total > 20_000
