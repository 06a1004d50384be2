"""Exclusive prefix sums on the device, and stream compaction (the indices of non-zero flags)."""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Reading, read_later
from pp_cl.device.device import Device
from pp_cl.device.launch import launch_groups

BLOCK = 512  # values that a work-item of a CPU scans
BLOCK_ON_GPU = 2048  # values that a work-group scans: four million take two levels


def block_values(dev: Device) -> int:
    """BLOCK of its kernels: values that one work-item, or on GPUs one work-group, scans."""
    return BLOCK if dev.is_cpu else BLOCK_ON_GPU


def exclusive_scan(dev: Device, values: Array, offsets: Array) -> None:
    """Write offsets[i] = sum of values[:i], so that offsets[N] is the total; at most 2^32 - 1,
    where sums stay.

    values: (N) uint32, N >= 1. offsets: (N+1) uint32.
    """
    _scan(dev, values, offsets, level=0)


def _scan(dev, values, offsets, level):
    """exclusive_scan() of the values or, from level 1 on, of sums of blocks."""
    n = values.size
    blocks = -(-n // block_values(dev))
    if blocks > 1:
        block_offset = _block_offsets(dev, "scan_sums", n, blocks, level=level, values=values)
    else:
        block_offset = _scratch(dev, ("scan offset", level), 2)
        dev.fill(block_offset, 0)
    _launch(
        dev,
        "scan_offsets",
        blocks,
        n=n,
        b=blocks,
        values=values,
        block_offset=block_offset,
        offsets=offsets,
    )


def _block_offsets(dev, kernel, n, blocks, *, level, **entries):
    """(blocks + 1,) prefix sums of what the kernel finds in each block of n entries."""
    block_offset = _scratch(dev, ("scan offset", level), blocks + 1)
    block_sum = _scratch(dev, ("scan sum", level), blocks)
    _launch(dev, kernel, blocks, n=n, b=blocks, block_sum=block_sum, **entries)
    _scan(dev, block_sum, block_offset, level + 1)
    return block_offset


def _scratch(dev, name, n):
    """(n,) uint32, of a power of two: numbers of pairs differ from step to step."""
    return dev.scratch(name, 1 << (n - 1).bit_length(), np.uint32)[:n]


def _launch(dev, kernel, blocks, **arguments):
    defines = {"BLOCK": block_values(dev)}
    launch_groups(dev, "device/scan", kernel, blocks, defines=defines, **arguments)


def read_total(dev: Device, offsets: Array) -> Reading[int]:
    """The last entry of `offsets`."""
    return read_later(dev, offsets, len(offsets) - 1, lambda last: int(last[0]))


def nonzero(dev: Device, flags: Array, indices: Array, places: Array) -> Reading[Array]:
    """(S,) uint32 on the device, the front of `indices`: where flags are not zero, ascending.

    flags: (N) uint8, N >= 1. indices: (N) uint32. places: (N) uint32, where each of them stands in
    `indices`; others are left alone.
    """
    n = flags.size
    blocks = -(-n // block_values(dev))
    block_offset = _block_offsets(dev, "count_nonzero", n, blocks, level=0, flags=flags)
    _launch(
        dev,
        "scan_nonzero",
        blocks,
        n=n,
        b=blocks,
        flags=flags,
        block_offset=block_offset,
        indices=indices,
        places=places,
    )
    return read_later(dev, block_offset, blocks, lambda total: indices[: int(total[0])])
