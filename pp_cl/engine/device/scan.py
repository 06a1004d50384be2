"""Exclusive prefix sums on the device, and stream compaction (the indices of non-zero flags)."""

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Pending, read_later
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import launch_groups

BLOCK = 1024  # values that a work-item of a CPU, or a work-group of a GPU, scans


def exclusive_scan(dev: Device, values: Array, offsets: Array) -> None:
    """Write offsets[i] = sum of values[:i], saturating at 2^32 - 1, so that offsets[N] is the
    total.

    values: (N) uint32, N >= 1. offsets: (N+1) uint32.
    """
    n = values.size
    block_sum = _block_sums(dev, "device/scan", "scan_sums", n, values=values)
    arrays = {"values": values, "block_sum": block_sum, "offsets": offsets}
    _launch(dev, "device/scan", "scan_offsets", n, **arrays)


def _block_sums(dev, file, kernel, n, **arrays):
    """(blocks,) or longer: the kernel's sum of each block of n numbers."""
    # rounded up to a power of two, as numbers of pairs differ from step to step
    held = dev.scratch("scan", 1 << (blocks_of(n) - 1).bit_length(), np.uint32)
    _launch(dev, file, kernel, n, block_sum=held, **arrays)
    return held


def blocks_of(n: int) -> int:
    """Number of blocks of n values."""
    return -(-n // BLOCK)


def _launch(dev, file, kernel, n, **arguments):
    blocks = blocks_of(n)
    launch_groups(dev, file, kernel, blocks, defines={"BLOCK": BLOCK}, n=n, b=blocks, **arguments)


def read_total(dev: Device, offsets: Array) -> Pending[int]:
    """The last number of `offsets`."""
    return read_later(dev, offsets, len(offsets) - 1, lambda last: int(last[0]))


def nonzero(dev: Device, flags: Array, indices: Array, places: Array, found: Array) -> None:
    """Write the ascending indices of non-zero flags to `indices`, and their number to `found`.

    flags: (N) uint8, N >= 1. indices: (N) uint32. places: (N) uint32, the position of each non-zero
    flag in `indices`; the others are left unchanged. found: (1,) uint32.
    """
    n = flags.size
    block_sum = _block_sums(dev, "device/nonzero", "count_nonzero", n, flags=flags)
    _launch(
        dev,
        "device/nonzero",
        "scan_nonzero",
        n,
        flags=flags,
        block_sum=block_sum,
        indices=indices,
        places=places,
        found=found,
    )
