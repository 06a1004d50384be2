"""Transfers that are not waited for."""

import numpy as np
import pytest

from pp_cl.device.transfer import read_later, send, shared_parts


def test_a_reading_is_what_the_kernels_before_it_left(dev, rng):
    """Whatever is enqueued after it."""
    first, second = (rng.normal(size=257).astype(np.float32) for _ in range(2))
    array = dev.upload(first)
    before = read_later(dev, array)
    send(dev, array, second)
    after = read_later(dev, array, 250)
    dev.fill(array, 0)
    assert np.array_equal(after.get(), second[250:]) and np.array_equal(before.get(), first)
    assert before.get() is before.get()


def test_what_is_sent_may_be_dropped_at_once(dev, rng):
    """The host's copy lives until it has arrived, and no longer."""
    array, expected = dev.empty((31, 7), np.int32), None
    for _ in range(20):
        expected = rng.integers(0, 99, (31, 7), dtype=np.int32)
        send(dev, array, expected.copy())
    assert np.array_equal(array.get(), expected)
    send(dev, array, expected)
    dev.finish()
    send(dev, array, expected)
    assert len(dev.sent) <= 2
    for wrong in (expected.T, expected.astype(np.float32)):
        with pytest.raises(ValueError, match="send: "):
            send(dev, array, wrong)


def test_parts_of_one_buffer(dev, rng):
    """Of any shapes and types, empty ones too; of a shorter one the front is sent."""
    forms = [((31, 3), np.float32), ((2, 0), np.int32), ((257,), np.uint32), ((1,), np.float32)]
    parts = shared_parts(dev, "some", forms)
    values = [rng.integers(1, 9, shape).astype(dtype) for shape, dtype in forms]
    parts.send(values)
    for part, value in zip(parts.arrays, values, strict=True):
        assert part.shape == value.shape and part.dtype == value.dtype
        assert np.array_equal(part.get(), value)
    used = dev.bytes
    assert shared_parts(dev, "some", list(forms)) is parts
    values = [values[0][:7] + 1, values[1], values[2][:9] + 1, values[3] + 1]
    parts.send(values)
    for part, value in zip(parts.arrays, values, strict=True):
        assert np.array_equal(part.get()[: len(value)], value)
    shared_parts(dev, "some", forms[:2])
    del parts, part
    assert dev.bytes < used


def test_a_kernel_reads_a_part(dev):
    parts = shared_parts(dev, "two", [((5,), np.float32), ((3,), np.float32)])
    parts.send([np.arange(5, dtype=np.float32), np.float32([7, -2, 3])])
    first, second = parts.arrays
    dev.copy(first[:3], second)
    assert first.get().tolist() == [7, -2, 3, 3, 4] and second.get().tolist() == [7, -2, 3]
