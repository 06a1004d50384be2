"""Transfers that are not waited for."""

import numpy as np
import pytest

from pp_cl.device.transfer import read_later, send, send_all


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


def test_several_arrays_by_one_transfer(dev, rng):
    """Of any sizes and types, empty ones too; in the same memory the next time."""
    values = [
        rng.normal(size=(31, 3)).astype(np.float32),
        np.empty((2, 0), np.int32),
        np.arange(257, dtype=np.uint32)[::2],
        np.float32([1]),
    ]
    for _ in range(2):
        parts = send_all(dev, "some", values)
        for part, array in zip(parts, values, strict=True):
            assert part.shape == array.shape and part.dtype == array.dtype
            assert np.array_equal(part.get(), array)
        used = dev.bytes
        values = values[::-1]
    send_all(dev, "some", values)
    assert dev.bytes == used


def test_a_kernel_reads_a_part(dev):
    first, second = send_all(dev, "two", [np.arange(5, dtype=np.float32), np.float32([7, -2, 3])])
    dev.copy(first[:3], second)
    assert first.get().tolist() == [7, -2, 3, 3, 4] and second.get().tolist() == [7, -2, 3]
