"""Transfers that are not waited for."""

import numpy as np
import pytest

from pp_cl.device.transfer import read_later


def test_a_reading_is_what_the_kernels_before_it_left(dev, rng):
    """Whatever is enqueued after it."""
    first, second = (rng.normal(size=257).astype(np.float32) for _ in range(2))
    array = dev.upload(first)
    before = read_later(dev, array)
    dev.send(array, second)
    after = read_later(dev, array, 250)
    dev.fill(array, 0)
    assert np.array_equal(after.get(), second[250:]) and np.array_equal(before.get(), first)
    assert before.get() is before.get()


def test_what_is_sent_may_be_dropped_at_once(dev, rng):
    """The host's copy lives until it has arrived, and no longer."""
    array, expected = dev.empty((31, 7), np.int32), None
    for _ in range(20):
        expected = rng.integers(0, 99, (31, 7), dtype=np.int32)
        dev.send(array, expected.copy())
    assert np.array_equal(array.get(), expected)
    dev.send(array, expected)
    dev.finish()
    dev.send(array, expected)
    assert len(dev._sent) <= 2
    for wrong in (expected.T, expected.astype(np.float32)):
        with pytest.raises(ValueError, match="write: "):
            dev.send(array, wrong)
