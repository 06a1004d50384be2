"""What the selftest does not test of buffers; it covers sizes and gathers."""

import weakref
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from pp_cl.engine.device.buffers import (
    Buffers,
    DeviceRows,
    PackedArrays,
    compact_rows,
    read_later,
    table_bytes,
)
from pp_cl.errors import UserError

pytestmark = pytest.mark.kernels  # they test rows.cl

TABLE = {"place": ((5, 4), np.float32), "box": ((5, 4), np.uint16)}


def test_arrays_are_what_the_table_declares(dev):
    before, buffers = dev.bytes, Buffers(dev)
    buffers.require(TABLE)
    place, box = buffers.place, buffers.box
    assert (place.shape, place.dtype, box.shape, box.dtype) == ((5, 4), "f4", (5, 4), "u2")
    assert dev.bytes - before == table_bytes(TABLE) == 5 * 4 * 6
    del box
    dev.reset_peak()
    buffers.require(TABLE | {"box": ((6, 4), np.uint16)})
    assert buffers.place is place and buffers.box.shape == (6, 4)
    assert dev.peak_bytes == dev.bytes == before + 5 * 4 * 4 + 6 * 4 * 2


def test_packed_arrays(dev, rng):
    rows = [((31, 3), np.float32), ((2, 0), np.int32), ((257,), np.uint32), ((1,), np.float32)]
    packed, before = PackedArrays(dev), dev.bytes
    values = [rng.integers(1, 9, shape).astype(dtype) for shape, dtype in rows]
    arrays = packed.send(rows, values)
    for array, value in zip(arrays, values, strict=True):
        assert array.shape == value.shape and array.dtype == value.dtype
        assert np.array_equal(array.get(), value)
    used, values = dev.bytes, [values[0][:7] + 1, values[1], values[2][:9] + 1, values[3] + 1]
    assert packed.send(list(rows), values) is arrays
    for array, value in zip(arrays, values, strict=True):
        assert np.array_equal(array.get()[: len(value)], value)
    del arrays, array
    packed.send(rows[:2], values[:2])
    assert before < dev.bytes < used


def test_a_pending_value_is_what_the_kernels_before_it_left(dev, rng):
    first, second = (rng.normal(size=257).astype(np.float32) for _ in range(2))
    array = dev.upload(first)
    before = read_later(dev, array)
    dev.send(array, second)
    after = read_later(dev, array, 250)
    dev.fill(array, 0)
    assert np.array_equal(after.get(), second[250:]) and np.array_equal(before.get(), first)
    assert before.get() is before.get()


def test_kernels_that_fail_on_the_device_are_told_of(dev, monkeypatch):
    """GPUs report many faults only when the host waits for the kernels."""

    def failing():
        raise cl.RuntimeError("clWaitForEvents failed: EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST")

    pending = read_later(dev, dev.zeros((3,)))
    pending._event = SimpleNamespace(wait=failing)
    with pytest.raises(UserError, match="cannot finish its work .*EXEC_STATUS"):
        pending.get()
    with monkeypatch.context() as patch:
        patch.setattr(dev, "queue", SimpleNamespace(finish=failing))
        with pytest.raises(UserError, match="cannot finish its work"):
            dev.finish()


def test_what_is_sent_may_be_dropped_at_once(dev, rng):
    array, expected = dev.empty((31, 7), np.int32), None
    for _ in range(20):
        expected = rng.integers(0, 99, (31, 7), dtype=np.int32)
        dev.send(array, expected.copy())
    assert np.array_equal(array.get(), expected)
    dev.send(array, expected)
    dev.finish()
    dev.send(array, expected)
    assert len(dev._sent) <= 2


@pytest.mark.parametrize("shape", [(), (16,), (3, 16), (7,)])
@pytest.mark.parametrize("pieces", [1, 3, 1000])
def test_compact(dev, rng, monkeypatch, shape, pieces):
    source = rng.integers(0, 2**32, (257, *shape), dtype=np.uint32).view(np.float32)
    indices = np.flatnonzero(rng.random(257) < 0.6).astype(np.uint32)
    scratch_bytes = 4 * int(np.prod(shape)) * -(-len(indices) // pieces)
    monkeypatch.setattr("pp_cl.engine.device.buffers.SCRATCH_BYTES", scratch_bytes)
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
    monkeypatch.setattr("pp_cl.engine.device.buffers.PIECE_BYTES", piece)
    parts = [rng.random((n, c, 16)).astype(np.float32) for c in (1, 2)]
    rows = DeviceRows(dev, *map(dev.upload, parts))
    assert rows.shape == (n, 3, 16) and rows.dtype == np.float32 and rows.nbytes == 192 * n
    assert all(p.nbytes <= max(piece, 192) for p in rows.pieces())
    np.testing.assert_array_equal(rows.get(), np.concatenate(parts, 1))


def test_what_was_fetched_or_written_is_not_kept(dev):
    """Otherwise a preview or a video would keep a dozen images besides the current one."""
    array, zeros = dev.upload(np.arange(9, dtype=np.float32)), np.zeros(9, np.float32)
    [packed] = PackedArrays(dev).send([((9,), np.float32)], [zeros])
    hosts = [dev.download(array), array.get(), array[:5].get(), packed.get(), zeros]
    dev.write(array, zeros)
    packed.set(zeros)
    dead = [weakref.ref(host) for host in hosts]
    del hosts, zeros
    assert [ref() for ref in dead] == [None] * 5
    assert not dev.download(array).any()
