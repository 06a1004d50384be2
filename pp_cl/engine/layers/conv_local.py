"""Direct convolutions for GPUs, 1x1 and 3x3, with any number of channels: a work-group shares
inputs and weights in local memory, and computes tiles of a list. Launches conv_local.cl and
conv_local_backward_weights.cl.
"""

import math
from collections.abc import Sequence

from pyopencl.array import Array

from pp_cl.engine.device.device import Program
from pp_cl.engine.layers.conv import Conv, ConvShape, mask_bits, most_parts
from pp_cl.engine.layers.tiles import MAP_TILE, VECTOR, Tiles, grid_shape

QUAD = 4  # channels of a work-item
# Work-items of a tile: each computes two lines of it, ROWS in cl/layers/conv_local.cl.
TILE_PARTS = 2
# Group sizes, tried in turn until the device runs one. Larger groups share the weights among more
# work-items; the largest still fits 32 KiB of local memory.
GROUPS = (256, 128, 64, 32)
# {side of the kernel: groups of four input channels of a work-group} for the weights' gradient
CI_QUADS = {3: 4, 1: 8}
# The most tiles that a work-item sums in registers there: a single sum over an image of background
# would lose digits. In narrow images it sums fewer, half as many pixels as the direct kernel, which
# sums a row, so that its errors stay below that kernel's.
SUMMED = 4
# Each part of that sum has at least PART_TILES tiles, and all parts together have at most about
# MOST_GROUPS work-groups, which fill a large GPU.
PART_TILES = 8
MOST_GROUPS = 512


def forward(conv: Conv, sources: Sequence[Array], out: Array, *, relu: bool, tiles: Tiles) -> None:
    """See conv_direct."""
    shape = conv.shape
    if conv.bias.size != -(-shape.co // VECTOR) * VECTOR:  # the kernel would not notice
        raise ValueError(f"bias has shape {conv.bias.shape}, expected that of {shape.co} channels")
    _launch(conv, shape.sources, (shape.co,), sources, (out,), (out,), (False,), relu, tiles)


def backward(
    conv: Conv,
    sources: Sequence[Array],
    grad_out: Array,
    grads: Sequence[Array],
    *,
    masks: Sequence[bool],
    tiles: Tiles,
    grad_tiles: Tiles,
) -> int:
    """See conv_direct. Uses two launches, as the two kernels need different group sizes."""
    shape = conv.shape
    _launch(conv, (shape.co,), shape.sources, (grad_out,), grads, sources, masks, False, grad_tiles)
    k, co, (_, width) = shape.k, shape.co, shape.size
    run = max(SUMMED, -(-tiles.number // parts_of(shape)))
    parts = -(-tiles.number // run)
    program, in_group, items = _weights_program(conv)
    groups = sum(-(-c // (QUAD * CI_QUADS[k])) for c in shape.sources)
    program.launch(
        "conv_local_backward_weights",
        (groups * items, -(-co // (QUAD * in_group)), parts),
        (items, 1, 1),
        multiply_adds=tiles.number * MAP_TILE**2 * shape.products,
        along=2,
        c1=shape.sources[0],
        c2=sum(shape.sources[1:]),
        co=co,
        run=run,
        summed=max(1, min(SUMMED, width // (2 * MAP_TILE * MAP_TILE))),
        x=sources[0],
        x2=sources[-1],
        grad_out=grad_out,
        tile_list=tiles.list,
        tile_count=tiles.count,
        partial=conv.partial,
    )
    return parts


def parts_of(shape: ConvShape) -> int:
    """The most parts into which the sum over an image for the gradient of weights is cut."""
    quads = _quads((shape.co,), _is_aligned(*shape.sources, shape.co))
    groups = -(-shape.ci // (QUAD * CI_QUADS[shape.k])) * -(-shape.co // (QUAD * quads))
    tiles = math.prod(grid_shape(*shape.size))
    wanted = min(-(-tiles // PART_TILES), -(-MOST_GROUPS // groups))
    return min(wanted, most_parts(shape))


def _launch(conv, inputs, channels, xs, results, mask_arrays, masks, relu, tiles):
    """Convolve the arrays xs, with `inputs` channels each, and write `tiles` of the results, with
    `channels` each, in the largest groups that the device runs.
    """
    tiles.check(conv.shape.size)
    aligned = _is_aligned(*channels, *inputs)
    in_group = _quads(channels, aligned)
    for items in (n for n in GROUPS if n >= TILE_PARTS * in_group):
        program = conv.dev.program(
            "layers/conv_local",
            ITEMS=items,
            KERNEL_SIZE=conv.shape.k,
            ALIGNED=int(aligned),
            QUADS=in_group,
        )
        if program.kernels["conv_local"].largest_group >= items:
            break
    groups = -(-tiles.number * TILE_PARTS * in_group // items)
    program.launch(
        "conv_local",
        (groups * items, sum(-(-c // (QUAD * in_group)) for c in channels)),
        (items, 1),
        multiply_adds=tiles.number * MAP_TILE**2 * conv.shape.products,
        c1=inputs[0],
        c2=sum(inputs[1:]),
        co1=channels[0],
        co2=sum(channels[1:]),
        forward=conv.shape.direction == "forward",
        relu=relu,
        masked=mask_bits(masks),
        x=xs[0],
        x2=xs[-1],
        weight=conv.work,
        bias=conv.bias,
        mask=mask_arrays[0],
        mask2=mask_arrays[-1],
        tile_list=tiles.list,
        out=results[0],
        out2=results[-1],
    )


def _weights_program(conv: Conv) -> tuple[Program, int, int]:
    """(program, groups of four output channels in a work-group, its work-items)."""
    k, aligned = conv.shape.k, _is_aligned(*conv.shape.sources, conv.shape.co)
    most = _quads((conv.shape.co,), aligned)
    for in_group in (n for n in (16, 8, 4) if n <= most):
        items = CI_QUADS[k] * in_group * k
        program = conv.dev.program(
            "layers/conv_local_backward_weights",
            KERNEL_SIZE=k,
            CI_QUADS=CI_QUADS[k],
            QUADS=in_group,
            ALIGNED=int(aligned),
        )
        if program.kernels["conv_local_backward_weights"].largest_group >= items:
            break
    return program, in_group, items


def _is_aligned(*channels):
    """Whether a pixel's channels can be read and written four at a time."""
    return all(c % QUAD == 0 for c in channels)


def _quads(channels, aligned):
    """How many groups of four of a result's channels a work-group computes: 16, 8 or 4, so that it
    computes none in vain; 4 for channels that are not aligned, as they are few.
    """
    blocks = (-(-c // VECTOR) for c in channels)
    return VECTOR // QUAD * (math.gcd(4, *blocks) if aligned else 1)
