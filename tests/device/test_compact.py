"""cl/device/compact.cl against numpy indexing."""

import numpy as np
import pytest
from support.guarded import AWKWARD_SIZES

from pp_cl.device.compact import compact_rows, gather_rows


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("shape", [(), (1,), (16,), (3, 16), (2, 16), (7,)])
@pytest.mark.parametrize("pieces", [1, 3, 1000])
def test_compact(dev, rng, monkeypatch, n, shape, pieces):
    """As a new array, in place by a few pieces, and in place row by row."""
    source = rng.standard_normal((n, *shape)).astype(np.float32)
    indices = np.flatnonzero(rng.random(n) < 0.6).astype(np.uint32)
    if not indices.size:
        indices = np.zeros(1, np.uint32)
    scratch_bytes = 4 * int(np.prod(shape)) * -(-len(indices) // pieces)
    monkeypatch.setattr("pp_cl.device.compact.SCRATCH_BYTES", scratch_bytes)
    before, array = dev.bytes, dev.upload(source)
    rows = compact_rows(dev, array, dev.upload(indices))
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(rows.get(), source[indices])
    in_place = pieces > 1 and len(indices) > 1
    assert (rows.base_data is array.base_data) == in_place
    del array
    assert dev.bytes == before + (source.nbytes if in_place else rows.nbytes)
    again = compact_rows(dev, rows, dev.upload(np.zeros(1, np.uint32)))
    del rows
    np.testing.assert_array_equal(again.get(), source[indices[:1]])
    assert dev.bytes == before + again.nbytes


@pytest.mark.parametrize("dtype", [np.uint32, np.float32, np.float16])
@pytest.mark.parametrize("scratch_bytes", [1, 2**20])
def test_compact_keeps_every_bit(dev, monkeypatch, dtype, scratch_bytes):
    monkeypatch.setattr("pp_cl.device.compact.SCRATCH_BYTES", scratch_bytes)
    bits = np.array([0, 0x7FC00001, 0xFFFFFFFF, 1, 0x80000000, 0x7FF87C01], np.uint32)[:, None]
    indices = dev.upload(np.array([1, 2, 4, 5], np.uint32))
    rows = compact_rows(dev, dev.upload(bits.view(dtype)), indices)
    np.testing.assert_array_equal(rows.get().view(np.uint32), bits[[1, 2, 4, 5]])


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("shape, dtype", [((), np.uint32), ((3, 16), np.float32), ((2, 16), "f2")])
def test_gather(dev, rng, n, shape, dtype):
    source = rng.integers(0, 2**15, (n, *shape)).astype(dtype)
    rows = rng.integers(0, n, 3 * n).astype(np.uint32)
    gathered = gather_rows(dev, dev.upload(source), dev.upload(rows))
    assert gathered.dtype == source.dtype
    np.testing.assert_array_equal(gathered.get(), source[rows])
