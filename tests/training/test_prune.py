"""cl/training/prune.cl against numpy indexing."""

import numpy as np
import pytest
from support.guarded import AWKWARD_SIZES

from pp_cl.training.prune import compact_rows, keep_indices, prune


def kept(dev, weights, least_weight, opacities, least_opacity):
    weights, opacities = (dev.upload(np.asarray(a, np.float32)) for a in (weights, opacities))
    indices = keep_indices(dev, weights, least_weight, opacities, least_opacity)
    assert indices.dtype == np.uint32
    return indices.get().tolist()


def test_keep_needs_weight_and_opacity(dev):
    assert kept(dev, [1, 0, 1, 0.5, 2], 0.5, [1, 1, 0, 0.5, 0.6], 0.5) == [0, 3, 4]
    assert kept(dev, [1, 0, 1], 0, [1, 1, 0], 0) == [0, 1, 2]
    assert kept(dev, [np.nan, 1, 1], 0, [1, 1, np.nan], 0) == [1]


@pytest.mark.parametrize(
    ("weights", "survivor"),
    [([1, 3, 2], 1), ([0, 0, 0], 0), ([np.nan, 1, 2], 2), ([np.nan] * 3, 0)],
)
def test_one_point_always_survives(dev, weights, survivor):
    assert kept(dev, weights, 5, [0, 0, 0], 0.01) == [survivor]


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("shape", [(), (1,), (16,), (3, 16), (2, 16), (7,)])
@pytest.mark.parametrize("pieces", [1, 3, 1000])
def test_compact(dev, rng, n, shape, pieces):
    """As a new array, in place by a few pieces, and in place row by row."""
    source = rng.standard_normal((n, *shape)).astype(np.float32)
    indices = np.flatnonzero(rng.random(n) < 0.6).astype(np.uint32)
    if not indices.size:
        indices = np.zeros(1, np.uint32)
    scratch_bytes = 4 * int(np.prod(shape)) * -(-len(indices) // pieces)
    before, array = dev.bytes, dev.upload(source)
    rows = compact_rows(dev, array, dev.upload(indices), scratch_bytes)
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(rows.get(), source[indices])
    in_place = pieces > 1 and len(indices) > 1
    assert (rows.base_data is array.base_data) == in_place
    del array
    assert dev.bytes == before + (source.nbytes if in_place else rows.nbytes)
    again = compact_rows(dev, rows, dev.upload(np.zeros(1, np.uint32)), scratch_bytes)
    del rows
    np.testing.assert_array_equal(again.get(), source[indices[:1]])
    assert dev.bytes == before + again.nbytes


@pytest.mark.parametrize("dtype", [np.uint32, np.float32, np.float16])
@pytest.mark.parametrize("scratch_bytes", [1, 2**20])
def test_compact_keeps_every_bit(dev, dtype, scratch_bytes):
    bits = np.array([0, 0x7FC00001, 0xFFFFFFFF, 1, 0x80000000, 0x7FF87C01], np.uint32)[:, None]
    indices = dev.upload(np.array([1, 2, 4, 5], np.uint32))
    rows = compact_rows(dev, dev.upload(bits.view(dtype)), indices, scratch_bytes)
    np.testing.assert_array_equal(rows.get().view(np.uint32), bits[[1, 2, 4, 5]])


@pytest.mark.parametrize("share", [2, 10])
def test_prune_never_takes_more_than_its_scratch(dev, rng, monkeypatch, share):
    scratch = 40_000
    monkeypatch.setattr("pp_cl.training.prune.SCRATCH_BYTES", scratch)
    host = {
        "ids": np.arange(1000, dtype=np.uint32),
        "opacity": rng.random(1000).astype(np.float32),
        "sh1": rng.random((1000, 3, 16)).astype(np.float32),
        "m.sh1": rng.random((1000, 3, 16)).astype(np.float32),
    }
    arrays = {name: dev.upload(values) for name, values in host.items()}
    keep = np.arange(0, 1000, share, dtype=np.uint32)
    indices = dev.upload(keep)
    before, dev.peak_bytes = dev.bytes, dev.bytes
    prune(dev, arrays, indices)
    for name, values in host.items():
        np.testing.assert_array_equal(arrays[name].get(), values[keep])
    assert dev.peak_bytes <= before + scratch
    assert before - dev.bytes == sum(
        v.nbytes - v[keep].nbytes for v in host.values() if v[keep].nbytes <= scratch
    )
