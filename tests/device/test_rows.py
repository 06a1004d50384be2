"""Arrays of a device that are read piece by piece."""

import weakref

import numpy as np
import pytest

from pp_cl.device.rows import DeviceRows


@pytest.mark.parametrize("piece", [1, 4 * 48 * 7, 2**26])
@pytest.mark.parametrize("n", [0, 1, 31, 257])
def test_parts_are_joined(dev, rng, monkeypatch, n, piece):
    monkeypatch.setattr("pp_cl.device.rows.PIECE_BYTES", piece)
    parts = [rng.random((n, c, 16)).astype(np.float32) for c in (1, 2)]
    rows = DeviceRows(dev, *map(dev.upload, parts))
    assert rows.shape == (n, 3, 16) and rows.dtype == np.float32 and rows.nbytes == 192 * n
    assert all(p.nbytes <= max(piece, 192) for p in rows.pieces())
    np.testing.assert_array_equal(rows.get(), np.concatenate(parts, 1))


@pytest.mark.parametrize("shape", [(5,), (5, 2), (5, 2, 3, 4)])
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


@pytest.mark.parametrize("values", [np.zeros(8, np.float32), np.zeros(9, np.float64)])
def test_writing_what_does_not_fit(dev, values):
    with pytest.raises(ValueError, match="write"):
        dev.write(dev.zeros((9,)), values)
