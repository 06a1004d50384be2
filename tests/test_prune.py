"""cl/prune.cl against numpy indexing."""

import numpy as np
import pytest
from helpers import AWKWARD_SIZES

from pp_cl.prune import gather_rows, keep_indices, prune


def kept(dev, weights, least_weight, opacities, least_opacity):
    weights, opacities = (dev.upload(np.asarray(a, np.float32)) for a in (weights, opacities))
    indices = keep_indices(dev, weights, least_weight, opacities, least_opacity)
    assert indices.dtype == np.uint32
    return indices.get().tolist()


def test_keep_needs_weight_and_opacity(dev):
    assert kept(dev, [1, 0, 1, 0.5, 2], 0.5, [1, 1, 0, 0.5, 0.6], 0.5) == [0, 3, 4]
    assert kept(dev, [1, 0, 1], 0, [1, 1, 0], 0) == [0, 1, 2]
    assert kept(dev, [np.nan, 1, 1], 0, [1, 1, np.nan], 0) == [1]


@pytest.mark.parametrize(("weights", "survivor"), [([1, 3, 2], 1), ([0, 0, 0], 0), ([np.nan, 1, 2], 2), ([np.nan] * 3, 0)])
def test_one_point_always_survives(dev, weights, survivor):
    assert kept(dev, weights, 5, [0, 0, 0], 0.01) == [survivor]


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("shape", [(), (1,), (16,), (3, 16), (5, 16), (7,)])
def test_gather(dev, rng, n, shape):
    source = rng.standard_normal((n, *shape)).astype(np.float32)
    indices = np.flatnonzero(rng.random(n) < 0.6).astype(np.uint32)
    if not indices.size:
        indices = np.zeros(1, np.uint32)
    rows = gather_rows(dev, dev.upload(source), dev.upload(indices))
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(rows.get(), source[indices])


def test_gather_keeps_every_bit(dev):
    source = np.array([0, 0x7FC00001, 0xFFFFFFFF, 1, 0x80000000], np.uint32)
    indices = dev.upload(np.array([4, 1, 2, 3], np.uint32))
    np.testing.assert_array_equal(gather_rows(dev, dev.upload(source), indices).get(), source[[4, 1, 2, 3]])
    bits = gather_rows(dev, dev.upload(source.view(np.float32)), indices).get().view(np.uint32)
    np.testing.assert_array_equal(bits, source[[4, 1, 2, 3]])


def test_prune_replaces_everything_and_releases(dev, rng):
    host = {"ids": np.arange(1000, dtype=np.uint32), "opacity": rng.random(1000).astype(np.float32),
            "sh2": rng.random((1000, 5, 16)).astype(np.float32), "m_sh2": rng.random((1000, 5, 16)).astype(np.float32)}
    arrays = {name: dev.upload(values) for name, values in host.items()}
    before, dev.peak_bytes = dev.bytes, dev.bytes
    keep = np.arange(0, 1000, 4, dtype=np.uint32)
    prune(dev, arrays, dev.upload(keep))
    for name, values in host.items():
        np.testing.assert_array_equal(arrays[name].get(), values[keep])
    held = sum(values.nbytes for values in host.values())
    assert dev.bytes <= before - held + held // 4 + 16
    assert dev.peak_bytes <= before + keep.nbytes + host["sh2"].nbytes // 4
