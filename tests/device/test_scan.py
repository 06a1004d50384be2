"""Prefix sums and the list of non-zero entries."""

import numpy as np
import pytest
from support.guarded import AWKWARD_SIZES

from pp_cl.device.form import LARGEST_GROUP
from pp_cl.device.scan import BLOCK, BLOCK_ON_GPU, exclusive_scan, nonzero, read_total

# one block of either form, its edges, two levels and three
EDGES = [edge for block in (BLOCK, BLOCK_ON_GPU) for edge in (block - 1, block, block + 1)]
SIZES = (*AWKWARD_SIZES, *EDGES, BLOCK * BLOCK, BLOCK * BLOCK + 1)


@pytest.mark.parametrize("n", [*SIZES, pytest.param(BLOCK_ON_GPU**2 + 1, marks=pytest.mark.large)])
def test_exclusive_scan(dev, rng, n):
    values = rng.integers(0, 9, n, dtype=np.uint32)
    offsets = dev.empty((n + 1,), np.uint32)
    exclusive_scan(dev, dev.upload(values), offsets)
    assert np.array_equal(offsets.get(), np.concatenate([[0], np.cumsum(values)]))
    assert read_total(dev, offsets).get() == values.sum()


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_nonzero(dev, rng, n, share):
    flags = rng.integers(1, 256, n).astype(np.uint8) * (rng.random(n) < share).astype(np.uint8)
    indices = dev.empty((n,), np.uint32)
    listed = nonzero(dev, dev.upload(flags), indices)
    assert np.array_equal(listed.get().get(), np.flatnonzero(flags))


def test_values_are_summed_exactly_up_to_32_bits(dev):
    values = np.array([2**31, 2**31 - 1, 0], np.uint32)
    offsets = dev.empty((4,), np.uint32)
    exclusive_scan(dev, dev.upload(values), offsets)
    assert offsets.get().tolist() == [0, 2**31, 2**32 - 1, 2**32 - 1]


@pytest.mark.parametrize("n", [LARGEST_GROUP, 2 * BLOCK_ON_GPU + 7])
def test_a_sum_above_the_largest_uint_stays_there(dev, n):
    """Within a group, and from one block to the next."""
    values = np.full(n, 2**29 + 1, np.uint32)
    offsets = dev.empty((n + 1,), np.uint32)
    exclusive_scan(dev, dev.upload(values), offsets)
    expected = np.minimum(np.arange(n + 1) * (2**29 + 1), 2**32 - 1)
    assert np.array_equal(offsets.get(), expected)
