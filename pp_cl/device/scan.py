"""Exclusive prefix sums on the device, and the list of the non-zero entries."""

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from pp_cl.device.device import Device

BLOCK = 512  # values per work-item


def exclusive_scan(dev: Device, values: Array, offsets: Array, flags: bool = False) -> None:
    """Write offsets[i] = sum of values[:i], so that offsets[N] is the total; at most 2^32 - 1,
    where sums stay.

    values: (N) uint32, N >= 1. offsets: (N+1) uint32. flags: every non-zero value counts as one.
    """
    n = values.size
    blocks = -(-n // BLOCK)
    program = dev.program("device/scan", FLAGS=int(flags), BLOCK=BLOCK)
    if blocks == 1:
        block_offset = dev.zeros((2,), np.uint32)
    else:
        block_sum = dev.empty((blocks,), np.uint32)
        block_offset = dev.empty((blocks + 1,), np.uint32)
        program.launch("scan_sums", blocks, n=n, b=blocks, values=values, block_sum=block_sum)
        exclusive_scan(dev, block_sum, block_offset)
    program.launch(
        "scan_offsets",
        blocks,
        n=n,
        b=blocks,
        values=values,
        block_offset=block_offset,
        offsets=offsets,
    )


def read_total(dev: Device, offsets: Array) -> int:
    """The last entry of `offsets` as an int; waits for the device."""
    total = np.empty(1, np.uint32)
    cl.enqueue_copy(dev.queue, total, offsets.data, src_offset=offsets.nbytes - total.nbytes)
    return int(total[0])


def nonzero(dev: Device, values: Array, offsets: Array, indices: Array) -> int:
    """Number of non-zero values; writes their indices, ascending, to the front of `indices`. Waits
    for the device.

    values: (N) uint32, N >= 1. offsets: (N+1) uint32 scratch, left holding each value's number.
    indices: (N) uint32.
    """
    n = values.size
    exclusive_scan(dev, values, offsets, flags=True)
    dev.program("device/scan", FLAGS=1, BLOCK=BLOCK).launch(
        "scan_nonzero", n, n=n, values=values, offsets=offsets, indices=indices
    )
    return read_total(dev, offsets)
