"""pp_cl/device/buffers.py: a table of arrays is allocated as declared, only what changed anew."""

import numpy as np
import pytest

from pp_cl.device.buffers import Buffers, table_bytes

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
