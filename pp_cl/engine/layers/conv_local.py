"""Direct convolutions for GPUs: a work-group shares inputs and weights in local memory, and
computes tiles of a list. Any channels, 1x1 and 3x3; the launches of conv_local.cl and of
conv_local_backward_weights.cl.
"""

import math
from collections.abc import Sequence

from pyopencl.array import Array

from pp_cl.engine.device.device import Program
from pp_cl.engine.layers.conv import Conv, ConvShape, mask_bits, most_parts
from pp_cl.engine.layers.tiles import SIDE, VECTOR, Tiles, grid_shape

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
# Parts of that sum: each of at least so many tiles, and no more than fill a large GPU: so many
# work-groups in all.
PART_TILES = 8
MOST_GROUPS = 512


def forward(conv: Conv, sources: Sequence[Array], out: Array, *, relu: bool, tiles: Tiles) -> None:
    """See conv_direct."""
    shape = conv.shape
    if conv.bias.size != -(-shape.co // VECTOR) * VECTOR:  # which the kernel takes in any length
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
    """See conv_direct. In two launches: groups of both kinds have other sizes."""
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
        multiply_adds=tiles.number * SIDE**2 * shape.products,
        along=2,
        c1=shape.sources[0],
        c2=sum(shape.sources[1:]),
        co=co,
        run=run,
        summed=max(1, min(SUMMED, width // (2 * SIDE * SIDE))),
        x=sources[0],
        x2=sources[-1],
        grad_out=grad_out,
        tile_list=tiles.list,
        tile_count=tiles.count,
        partial=conv.partial,
    )
    return parts


def parts_of(shape: ConvShape) -> int:
    """Into how many parts the sum over an image for the gradient of weights is cut, at most."""
    quads = _quads((shape.co,), _is_aligned(*shape.sources, shape.co))
    groups = -(-shape.ci // (QUAD * CI_QUADS[shape.k])) * -(-shape.co // (QUAD * quads))
    tiles = math.prod(grid_shape(*shape.size))
    wanted = min(-(-tiles // PART_TILES), -(-MOST_GROUPS // groups))
    return min(wanted, most_parts(shape))


def _launch(conv, inputs, channels, xs, results, mask_arrays, masks, relu, tiles):
    """Convolve arrays of so many channels each to the tiles of results of so many; in the largest
    groups that the device runs.
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
        multiply_adds=tiles.number * SIDE**2 * conv.shape.products,
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
    """(program, groups of four output channels and work-items of a work-group)."""
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
    """Whether four channels of a pixel are read and written at once."""
    return all(c % QUAD == 0 for c in channels)


def _quads(channels, aligned):
    """Groups of four of a result's channels that a work-group computes: 16, 8 or 4, so that nothing
    is computed in vain. Channels that are not aligned are few.
    """
    blocks = (-(-c // VECTOR) for c in channels)
    return VECTOR // QUAD * (math.gcd(4, *blocks) if aligned else 1)
