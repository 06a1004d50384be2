"""Rows of device arrays: moved without a second array, read piece by piece. The selftest has sizes
and gathers.
"""

import weakref

import numpy as np
import pytest

from pp_cl.device.rows import DeviceRows, compact_rows


@pytest.mark.parametrize("shape", [(), (16,), (3, 16), (7,)])
@pytest.mark.parametrize("pieces", [1, 3, 1000])
def test_compact(dev, rng, monkeypatch, shape, pieces):
    """As a new array, in place by a few pieces, and in place row by row; every bit is kept."""
    source = rng.integers(0, 2**32, (257, *shape), dtype=np.uint32).view(np.float32)
    indices = np.flatnonzero(rng.random(257) < 0.6).astype(np.uint32)
    scratch_bytes = 4 * int(np.prod(shape)) * -(-len(indices) // pieces)
    monkeypatch.setattr("pp_cl.device.rows.SCRATCH_BYTES", scratch_bytes)
    before, array = dev.bytes, dev.upload(source)
    rows = compact_rows(dev, array, dev.upload(indices))
    np.testing.assert_array_equal(rows.get().view(np.uint32), source[indices].view(np.uint32))
    assert (rows.base_data is array.base_data) == (pieces > 1)
    del array
    assert dev.bytes == before + (source.nbytes if pieces > 1 else rows.nbytes)
    again = compact_rows(dev, rows, dev.upload(np.zeros(1, np.uint32)))
    del rows
    assert dev.bytes == before + again.nbytes


@pytest.mark.parametrize("piece", [1, 4 * 48 * 7, 2**26])
@pytest.mark.parametrize("n", [0, 1, 31, 257])
def test_parts_are_joined(dev, rng, monkeypatch, n, piece):
    monkeypatch.setattr("pp_cl.device.rows.PIECE_BYTES", piece)
    parts = [rng.random((n, c, 16)).astype(np.float32) for c in (1, 2)]
    rows = DeviceRows(dev, *map(dev.upload, parts))
    assert rows.shape == (n, 3, 16) and rows.dtype == np.float32 and rows.nbytes == 192 * n
    assert all(p.nbytes <= max(piece, 192) for p in rows.pieces())
    np.testing.assert_array_equal(rows.get(), np.concatenate(parts, 1))


@pytest.mark.parametrize("shape", [(5,), (5, 2, 3, 4)])
def test_one_array_of_any_shape(dev, shape):
    values = np.arange(np.prod(shape), dtype=np.uint32).reshape(shape)
    rows = DeviceRows(dev, dev.upload(values))
    assert rows.shape == shape
    np.testing.assert_array_equal(rows.get(), values)


def test_what_was_fetched_or_written_is_not_kept(dev):
    """pyopencl's own get and set tie the numpy array to the device's."""
    array = dev.upload(np.arange(9, dtype=np.float32))
    fetched, written = dev.download(array), np.zeros(9, np.float32)
    dev.write(array, written)
    dead = [weakref.ref(fetched), weakref.ref(written)]
    del fetched, written
    assert [ref() for ref in dead] == [None, None]
    assert not dev.download(array).any()
