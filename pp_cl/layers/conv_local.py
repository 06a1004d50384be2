"""Direct convolutions for GPUs: a work-group shares inputs and weights in local memory, and
computes tiles of a list. Any channels, 1x1 and 3x3; weights and scratch are conv_direct's.
"""

import math

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.conv_direct import (
    Blocking,
    check_shape,
    image_parts,
    lay_out,
    packed_shape,
    parts_shape,
    scratch_floats,
    work_shape,
)
from pp_cl.layers.tiles import SIDE, VECTOR, Tiles, checked_tiles

__all__ = [
    "backward_input",
    "backward_weights",
    "forward",
    "lay_out",
    "scratch_floats",
    "work_shape",
]

QUAD = 4  # channels of a work-item
# Pixels of a work-item: two lines of a tile, ROWS in cl/layers/conv_local.cl.
TILE_PARTS = 2
# Work-items of a group that are tried, until a device runs so many. More share the weights, and fit
# 32 KiB of local memory up to the first number.
GROUPS = (256, 128, 64, 32)
# {side of the kernel: groups of four input channels of a work-group} in the gradient of the weights
CI_QUADS = {3: 4, 1: 8}
# Tiles that a work-item sums in registers there, at most: one sum over an image of background would
# lose digits. Fewer of narrow images, so that it sums half as many pixels as the direct kernel,
# which sums a row: errors stay below that one's.
SUMMED = 4


def forward(
    dev: Device,
    _blocking: Blocking,
    sources: tuple[Array, ...],
    weights: Array,
    bias: Array,
    out: Array,
    *,
    relu: bool,
    tiles: Tiles | None = None,
) -> None:
    """See conv_direct.forward."""
    height, width, co = out.shape
    k, channels = weights.shape[1], [source.shape[2] for source in sources]
    check_shape(channels, co, weights, packed_shape(k, sum(channels), co), bias)
    tiles = checked_tiles(dev, tiles, height, width)
    program, size, work_group = _program(dev, "conv_local_forward", k, tiles, co, channels)
    program.launch(
        "conv_local_forward",
        size,
        local=work_group,
        multiply_adds=tiles.number * SIDE**2 * k**2 * sum(channels) * co,
        c1=channels[0],
        c2=sum(channels[1:]),
        co=co,
        relu=relu,
        x=sources[0],
        x2=sources[-1],
        weight=weights,
        bias=bias,
        tile_list=tiles.list,
        out=out,
    )


def backward_input(
    dev: Device,
    _blocking: Blocking,
    weights: Array,
    grad_out: Array,
    grad_x: Array,
    *,
    mask: Array | None,
    tiles: Tiles | None = None,
) -> None:
    """See conv_direct.backward_input."""
    height, width, c = grad_x.shape
    k, co = weights.shape[1], grad_out.shape[2]
    check_shape([c], co, weights, packed_shape(k, co, c))
    tiles = checked_tiles(dev, tiles, height, width)
    program, size, work_group = _program(dev, "conv_local_backward_input", k, tiles, c, [co])
    program.launch(
        "conv_local_backward_input",
        size,
        local=work_group,
        multiply_adds=tiles.number * SIDE**2 * k**2 * co * c,
        c=c,
        co=co,
        masked=mask is not None,
        x=grad_x if mask is None else mask,
        flipped=weights,
        grad_out=grad_out,
        tile_list=tiles.list,
        grad_x=grad_x,
    )


def backward_weights(
    dev: Device,
    _blocking: Blocking,
    sources: tuple[Array, ...],
    grad_out: Array,
    partial: Array,
    *,
    tiles: Tiles | None = None,
) -> int:
    """See conv_direct.backward_weights. The order of the sums depends on the shapes and the number
    of tiles alone.
    """
    height, width, co = grad_out.shape
    channels = [source.shape[2] for source in sources]
    ci = sum(channels)
    k = math.isqrt((partial.shape[2] - 1) // ci)
    most, _ = image_parts(height, k, ci, co)
    check_shape(channels, co, partial, parts_shape(most, k, ci, co))
    tiles = checked_tiles(dev, tiles, height, width)
    run = max(SUMMED, -(-tiles.number // most))
    parts = -(-tiles.number // run)
    first = 0
    for source, c in zip(sources, channels, strict=True):
        program, in_group, items = _weights_program(dev, k, c, co)
        program.launch(
            "conv_local_backward_weights",
            (-(-c // (QUAD * CI_QUADS[k])) * items, -(-co // (QUAD * in_group)), parts),
            local=(items, 1, 1),
            multiply_adds=tiles.number * SIDE**2 * k**2 * c * co,
            c=c,
            first=first,
            ci=ci,
            summed=max(1, min(SUMMED, width // (2 * SIDE * SIDE))),
            x=source,
            co=co,
            run=run,
            grad_out=grad_out,
            tile_list=tiles.list,
            tile_count=tiles.count,
            partial=partial,
        )
        first += c
    program.launch(
        "conv_local_backward_bias",
        (-(-co // VECTOR) * VECTOR, parts),
        per_block=k * k * ci,
        parts=parts,
        co=co,
        run=run,
        grad_out=grad_out,
        tile_list=tiles.list,
        tile_count=tiles.count,
        partial=partial,
    )
    return parts


def _is_aligned(*channels):
    """Whether four channels of a pixel are read and written at once."""
    return all(c % QUAD == 0 for c in channels)


def _quads(channels, aligned):
    """Groups of four of the output channels that a work-group computes: 16, 8 or 4, so that nothing
    is computed in vain. Channels that are not aligned are few.
    """
    blocks = -(-channels // VECTOR)
    return VECTOR // QUAD * (math.gcd(blocks, 4) if aligned else 1)


def _program(dev, kernel, k, tiles, channels, inputs):
    """(program, work-items, work-group) of a kernel for `channels` of `inputs` [channels], in the
    largest groups that the device runs.
    """
    aligned = _is_aligned(channels, *inputs)
    in_group = _quads(channels, aligned)
    for items in (n for n in GROUPS if n >= TILE_PARTS * in_group):
        program = dev.program(
            "layers/conv_local",
            ITEMS=items,
            KERNEL_SIZE=k,
            ALIGNED=int(aligned),
            QUADS=in_group,
        )
        if program.kernels[kernel].largest_group >= items:
            break
    groups = -(-tiles.number * TILE_PARTS * in_group // items)
    return program, (groups * items, -(-channels // (QUAD * in_group))), (items, 1)


def _weights_program(dev, k, c, co):
    """(program, groups of four output channels and work-items of a work-group)."""
    aligned = _is_aligned(c, co)
    most = _quads(co, aligned)
    for in_group in (n for n in (16, 8, 4) if n <= most):
        items = CI_QUADS[k] * in_group * k
        program = dev.program(
            "layers/conv_local_backward_weights",
            KERNEL_SIZE=k,
            CI_QUADS=CI_QUADS[k],
            QUADS=in_group,
            ALIGNED=int(aligned),
        )
        if program.kernels["conv_local_backward_weights"].largest_group >= items:
            break
    return program, in_group, items
