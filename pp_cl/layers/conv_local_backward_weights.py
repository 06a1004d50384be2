"""Weight and bias gradients of the direct convolutions for GPUs, through local memory."""

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.conv_backward_weights import (
    check_scratch,
    check_shapes,
    most_parts,
    partial_floats,
    sum_parts,
)
from pp_cl.layers.conv_local import QUAD, is_aligned, quads, runs
from pp_cl.layers.tiles import LANES, SIDE, Tiles, checked_tiles

# {side of the kernel: groups of four input channels of a work-group}
CI_QUADS = {3: 4, 1: 8}
# Tiles that a work-item sums in registers, at most: one sum over an image of background would lose
# digits. Fewer of narrow images, so that it sums half as many pixels as the direct kernel, which
# sums a row: errors stay below that one's.
SUMMED = 4


def conv_local_backward_weights(
    dev: Device,
    sources: tuple[Array, ...],
    grad_out: Array,
    grad_weight: Array,
    *,
    grad_bias: Array,
    partial: Array,
    tiles: Tiles | None = None,
) -> None:
    """As conv_backward_weights.conv_backward_weights, with as much scratch. The order of the sums
    depends on the shapes and the number of tiles alone.
    """
    height, width, co = grad_out.shape
    blocks, k, _, ci, _ = grad_weight.shape
    check_shapes(sources, grad_out, grad_weight, grad_bias)
    check_scratch(partial, partial_floats(height, grad_weight.shape))
    tiles = checked_tiles(dev, tiles, height, width)
    run = max(SUMMED, -(-tiles.number // most_parts(height, grad_weight.shape)))
    parts = -(-tiles.number // run)
    common = {
        "co": co,
        "run": run,
        "grad_out": grad_out,
        "tile_list": tiles.list,
        "tile_count": tiles.count,
        "partial": partial,
    }
    summed = max(1, min(SUMMED, width // (2 * SIDE * SIDE)))
    for i, x in enumerate(sources):
        c = x.shape[2]
        program, in_group, items = _program(dev, k, c, co)
        program.launch(
            "conv_local_backward_weights",
            (-(-c // (QUAD * CI_QUADS[k])) * items, -(-co // (QUAD * in_group)), parts),
            local=(items, 1, 1),
            multiply_adds=tiles.number * SIDE**2 * k**2 * c * co,
            c=c,
            first=sum(before.shape[2] for before in sources[:i]),
            ci=ci,
            summed=summed,
            x=x,
            **common,
        )
    channels, per_block = blocks * LANES, k * k * ci
    program.launch(
        "conv_local_backward_bias", (channels, parts), per_block=per_block, parts=parts, **common
    )
    sum_parts(dev, partial, grad_weight, grad_bias, parts=parts)


def _program(dev, k, c, co):
    """(program, groups of four output channels and work-items of a work-group)."""
    aligned = is_aligned(c, co)
    most = quads(co, aligned)
    for in_group in (n for n in (16, 8, 4) if n <= most):
        items = CI_QUADS[k] * in_group * k
        macros = {"KERNEL_SIZE": k, "CI_QUADS": CI_QUADS[k], "QUADS": in_group}
        program = dev.program("layers/conv_local_backward_weights", ALIGNED=int(aligned), **macros)
        if runs(program, "conv_local_backward_weights", items):
            break
    return program, in_group, items
