"""Direct convolutions K x K (K = 1 or 3) for GPUs: a work-group shares inputs and weights in local
memory, and computes tiles of a list.
"""

import math

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import Program
from pp_cl.layers.conv import check_flipped, check_forward
from pp_cl.layers.tiles import LANES, SIDE, Tiles, checked_tiles

QUAD = 4  # channels of a work-item
# Pixels of a work-item: two lines of a tile, ROWS in cl/layers/conv_local.cl.
TILE_PARTS = 2
# Work-items of a group that are tried, until a device runs so many. More share the weights, and fit
# 32 KiB of local memory up to the first number.
GROUPS = (256, 128, 64, 32)


def conv_local_forward(
    dev: Device,
    sources: tuple[Array, ...],
    weight: Array,
    bias: Array,
    *,
    out: Array,
    relu: bool,
    tiles: Tiles | None = None,
) -> None:
    """As conv.conv_forward."""
    height, width, co = out.shape
    check_forward(sources, weight, bias, out)
    channels = [source.shape[2] for source in sources]
    tiles = checked_tiles(dev, tiles, height, width)
    _launch(
        dev,
        "conv_local_forward",
        (weight.shape[1], tiles, co, channels),
        c1=channels[0],
        c2=sum(channels[1:]),
        co=co,
        relu=relu,
        x=sources[0],
        x2=sources[-1],
        weight=weight,
        bias=bias,
        tile_list=tiles.list,
        out=out,
    )


def conv_local_backward_input(
    dev: Device,
    flipped: Array,
    grad_out: Array,
    grad_x: Array,
    *,
    mask: Array | None,
    tiles: Tiles | None = None,
) -> None:
    """As conv.conv_backward_input."""
    height, width, c = grad_x.shape
    check_flipped(flipped, grad_x)
    tiles = checked_tiles(dev, tiles, height, width)
    _launch(
        dev,
        "conv_local_backward_input",
        (flipped.shape[1], tiles, c, grad_out.shape[2:]),
        c=c,
        co=grad_out.shape[2],
        masked=mask is not None,
        x=grad_x if mask is None else mask,
        flipped=flipped,
        grad_out=grad_out,
        tile_list=tiles.list,
        grad_x=grad_x,
    )


def is_aligned(*channels: int) -> bool:
    """Whether four channels of a pixel are read and written at once."""
    return all(c % QUAD == 0 for c in channels)


def quads(channels: int, aligned: bool) -> int:
    """Groups of four of the output channels that a work-group computes: 16, 8 or 4, so that nothing
    is computed in vain. Channels that are not aligned are few.
    """
    blocks = -(-channels // LANES)
    return LANES // QUAD * (math.gcd(blocks, 4) if aligned else 1)


def runs(program: Program, kernel: str, items: int) -> bool:
    """Whether the device runs a kernel in work-groups of so many items."""
    return program.kernels[kernel].largest_group >= items


def _launch(dev, kernel, form, **arguments):
    """form: (side of the kernel, tiles, channels of the output, of the inputs)."""
    k, tiles, channels, inputs = form
    aligned = is_aligned(channels, *inputs)
    in_group = quads(channels, aligned)
    macros = {"KERNEL_SIZE": k, "ALIGNED": int(aligned), "QUADS": in_group}
    for items in (n for n in GROUPS if n >= TILE_PARTS * in_group):
        program = dev.program("layers/conv_local", ITEMS=items, **macros)
        if runs(program, kernel, items):
            break
    groups = -(-tiles.number * TILE_PARTS * in_group // items)
    size = (groups * items, -(-channels // (QUAD * in_group)))
    multiply_adds = tiles.number * SIDE**2 * k**2 * sum(inputs) * channels
    program.launch(kernel, size, local=(items, 1), multiply_adds=multiply_adds, **arguments)
