"""Direct convolutions, 1x1 and 3x3, with any number of channels: launches conv.cl and
conv_backward.cl.
"""

import math
from collections.abc import Sequence

from pyopencl.array import Array

from pp_cl.engine.device.device import Program
from pp_cl.engine.layers.conv import Conv, ConvShape, mask_bits, most_parts
from pp_cl.engine.layers.tiles import MAP_TILE, VECTOR, Tiles

# Image rows that one work-item sums for the gradient of the weights: few enough to stay in a core's
# cache, and to give all cores a part.
ROWS_PER_PART = 8


def forward(conv: Conv, sources: Sequence[Array], out: Array, *, relu: bool, tiles: Tiles) -> None:
    """out = convolution of the sources' concatenation + bias, then max(., 0) if relu.

    sources: one or two of (H, W, C1), (H, W, C2) float32; out: (H, W, CO) float32; tiles: the tiles
    of out to compute. Raises ValueError for arrays and tiles of other shapes.
    """
    shape = conv.shape
    program, size = _program(conv, "layers/conv", (shape.co,), (tiles,))
    program.launch(
        "conv_forward",
        size,
        conv.blocking.work_group,
        multiply_adds=tiles.number * MAP_TILE**2 * shape.products,
        along=1,
        height=shape.size[0],
        width=shape.size[1],
        c1=shape.sources[0],
        c2=sum(shape.sources[1:]),
        co=shape.co,
        relu=relu,
        x=sources[0],
        x2=sources[-1],
        weight=conv.work,
        bias=conv.bias,
        tile_count=tiles.count,
        out=out,
    )


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
    """Write the gradients of the sources, and write to conv.partial the gradients of the weights
    and biases of forward(), one sum for each part of the image; returns the number of parts, which
    conv.sum_parts() adds up.

    grad_out: (H, W, CO) float32, dL/dout before the ReLU. grads: like the sources. masks: for each
    source, whether it is a ReLU's output: then its gradient is that of the ReLU's input. tiles: the
    tiles of grad_out to sum, each multiplied by its count; grad_tiles: the tiles of grads to
    compute. The order of the sums depends on the shapes alone; in other variants also on the number
    of tiles. Raises ValueError like forward().
    """
    shape, (height, width), parts = conv.shape, conv.shape.size, parts_of(conv.shape)
    # input channels of a work-item: the sums, k for each channel, must fit the registers
    most = conv.blocking.accumulators // shape.k
    group = next(n for n in (16, 8, 4, 2, 1) if n <= most and math.gcd(*shape.sources) % n == 0)
    file, maps = "layers/conv_backward", (tiles, grad_tiles)
    program, size = _program(conv, file, shape.sources, maps, CI_GROUP=group)
    sums, others = shape.ci // group * shape.k * -(-shape.co // VECTOR) * parts, math.prod(size)
    program.launch(
        "conv_backward",
        sums + others,
        conv.blocking.work_group and 1,
        # as if all work-items did as much work as the busiest
        multiply_adds=height * width * shape.products * (sums + others) / min(sums, others),
        height=height,
        width=width,
        c1=shape.sources[0],
        c2=sum(shape.sources[1:]),
        co=shape.co,
        masked=mask_bits(masks),
        rows=_rows(shape),
        x=sources[0],
        x2=sources[-1],
        flipped=conv.work,
        grad_out=grad_out,
        tile_count=tiles.count,
        grad_tiles=grad_tiles.count,
        partial=conv.partial,
        grad_x=grads[0],
        grad_x2=grads[-1],
    )
    return parts


def parts_of(shape: ConvShape) -> int:
    """The most parts into which the sum over an image for the gradient of weights is cut."""
    return -(-shape.size[0] // _rows(shape))


def _rows(shape):
    """Image rows in one part."""
    return max(ROWS_PER_PART, -(-shape.size[0] // most_parts(shape)))


def _program(
    conv: Conv, file: str, channels: Sequence[int], tiles: Sequence[Tiles], **defines: int
) -> tuple[Program, tuple[int, int, int]]:
    """(program, work-items) for results with these numbers of channels; no work-item computes
    unneeded groups of channels or rows.
    """
    for of_map in tiles:
        of_map.check(conv.shape.size)
    (height, width), blocks = conv.shape.size, [-(-c // VECTOR) for c in channels]
    pixels, groups = conv.blocking.direct
    if math.gcd(*blocks) % groups:
        pixels, groups = conv.blocking.direct_odd
    pixels = next(p for p in (pixels, 8, 4, 1) if p <= width)
    size = (-(-width // pixels), height, sum(-(-n // groups) for n in blocks))
    defines |= {"KERNEL_SIZE": conv.shape.k, "PIXELS": pixels, "BLOCKS": groups}
    return conv.dev.program(file, **defines), size
