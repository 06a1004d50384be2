"""A table of arrays is allocated as declared, only what changed anew; packed arrays."""

import numpy as np
import pytest

from pp_cl.device.buffers import Buffers, PackedArrays, table_bytes

TABLE = {"place": ((5, 4), np.float32), "box": ((5, 4), np.uint16)}


def test_arrays_are_what_the_table_declares(dev):
    before = dev.bytes
    buffers = Buffers(dev)
    buffers.require(TABLE)
    assert (buffers.place.shape, buffers.place.dtype) == ((5, 4), np.float32)
    assert (buffers.box.shape, buffers.box.dtype) == ((5, 4), np.uint16)
    assert dev.bytes - before == table_bytes(TABLE) == 5 * 4 * 6


def test_only_what_changed_is_allocated_anew(dev):
    buffers = Buffers(dev)
    buffers.require(TABLE)
    place, box = buffers.place, buffers.box
    buffers.require(TABLE | {"box": ((6, 4), np.uint16)})
    assert buffers.place is place
    assert buffers.box is not box
    assert buffers.box.shape == (6, 4)


def test_the_old_array_is_released_before_the_new_one_is_allocated(dev):
    buffers = Buffers(dev)
    buffers.require({"large": ((1000,), np.float32)})
    dev.peak_bytes = dev.bytes
    buffers.require({"large": ((1001,), np.float32)})
    assert dev.peak_bytes == dev.bytes


def test_a_name_that_was_not_required(dev):
    with pytest.raises(AttributeError, match="'absent'"):
        Buffers(dev).absent  # noqa: B018


def test_packed_arrays(dev, rng):
    """Of any shapes and types, empty ones too; of a shorter one the front is sent."""
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


def test_a_kernel_reads_a_packed_array(dev):
    rows = [((5,), np.float32), ((3,), np.float32)]
    first, second = PackedArrays(dev).send(rows, [np.arange(5, dtype="f4"), np.float32([7, -2, 3])])
    dev.copy(first[:3], second)
    assert first.get().tolist() == [7, -2, 3, 3, 4] and second.get().tolist() == [7, -2, 3]
