"""Direct convolutions, of any channels, 1x1 and 3x3: the launches of conv.cl and of
conv_backward_weights.cl.
"""

from collections.abc import Sequence

from pyopencl.array import Array

from pp_cl.engine.device.device import Device, Program
from pp_cl.engine.device.launch import lanes
from pp_cl.engine.layers.conv import Conv, ConvShape, first_float, most_parts
from pp_cl.engine.layers.tiles import SIDE, VECTOR, Tiles

# Rows of the image that one work-item sums for the gradient of the weights: few enough to stay in a
# core's cache, and enough parts for all cores.
ROWS_PER_PART = 8


def forward(conv: Conv, sources: Sequence[Array], out: Array, *, relu: bool, tiles: Tiles) -> None:
    """out = convolution of the sources' concatenation + bias, then max(., 0) if relu.

    sources: one or two of (H, W, C1), (H, W, C2) float32; out: (H, W, CO) float32; tiles: those of
    out to compute. Raises ValueError for arrays and tiles of other shapes.
    """
    shape = conv.shape
    program, size, work_group = _program(conv, shape.co, tiles)
    program.launch(
        "conv_forward",
        size,
        work_group,
        multiply_adds=tiles.number * SIDE**2 * shape.products,
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


def backward_input(
    conv: Conv, grad_out: Array, grad_x: Array, *, mask: Array | None, tiles: Tiles
) -> None:
    """grad_x = gradient of the convolution's input, 0 where mask <= 0.

    grad_out: (H, W, CO) float32, dL/dout before the ReLU; grad_x: (H, W, C) float32; mask: (H, W,
    C), the input where it is a ReLU's output, so that grad_x is the gradient of the ReLU's input,
    or None; tiles: those of grad_x to compute. Raises ValueError as forward().
    """
    shape = conv.shape
    program, size, work_group = _program(conv, shape.ci, tiles)
    program.launch(
        "conv_backward_input",
        size,
        work_group,
        multiply_adds=tiles.number * SIDE**2 * shape.products,
        along=1,
        height=shape.size[0],
        width=shape.size[1],
        c=shape.ci,
        co=shape.co,
        masked=mask is not None,
        x=grad_x if mask is None else mask,
        flipped=conv.work,
        grad_out=grad_out,
        tile_count=tiles.count,
        grad_x=grad_x,
    )


def backward_weights(conv: Conv, sources: Sequence[Array], grad_out: Array, *, tiles: Tiles) -> int:
    """Write the gradients of the weights and biases of forward(), given dL/dout (H, W, CO) before
    the ReLU, as sums of the image's parts to conv.work; returns the number of parts, which
    conv.sum_parts() sums.

    tiles: those of grad_out to sum, each as often as it counts. The order of the sums depends on
    the shapes alone, with other variants on the number of tiles too. Raises ValueError as
    forward().
    """
    shape, (parts, rows), first = conv.shape, _image_parts(conv.shape), 0
    for source, c in zip(sources, shape.sources, strict=True):
        # input channels of a work-item, whose sums, k for each, fit the registers
        group = next(
            n for n in (16, 8, 4, 2, 1) if n * shape.k <= conv.blocking.accumulators and c % n == 0
        )
        conv.dev.program(
            "layers/conv_backward_weights", KERNEL_SIZE=shape.k, CI_GROUP=group
        ).launch(
            "conv_backward_weights",
            (c // group * shape.k, -(-shape.co // VECTOR), parts),
            conv.blocking.work_group,
            multiply_adds=shape.size[0] * shape.size[1] * shape.k**2 * c * shape.co,
            along=2,
            height=shape.size[0],
            width=shape.size[1],
            c=c,
            co=shape.co,
            first=first,
            ci=shape.ci,
            rows=rows,
            x=source,
            grad_out=grad_out,
            tile_count=tiles.count,
            partial=conv.work,
        )
        first += c
    return parts


def parts_of(shape: ConvShape) -> int:
    """Into how many parts the sum over an image for the gradient of weights is cut, at most."""
    return _image_parts(shape)[0]


def flip_weights(dev: Device, convs: Sequence[Conv], weights: Array, work: Array) -> None:
    """Lay out the weights of input gradients in one launch: with the kernel mirrored and the roles
    of input and output channels exchanged, (ceil(CI/16), K, K, CO, 16).

    weights, work: (?,) float32, in which Conv.weight and Conv.work lie.
    """
    rows, n = [], 0
    for conv in convs:
        shape = conv.shape
        blocks, ci, taps = -(-shape.ci // VECTOR), sum(shape.sources), shape.k**2
        taken = min(ci - shape.first, blocks * VECTOR)
        start, target = first_float(conv.weight), first_float(conv.work) // VECTOR
        rows.append((n, taps, shape.co, taken, shape.first, ci, start, target))
        n += shape.co * taps * blocks
    dev.program("layers/conv_backward_weights", LANES=lanes(dev)).launch(
        "conv_flip_weights",
        n,
        n=n,
        rows=len(rows),
        table=dev.constant(rows),
        weights=weights,
        flipped=work,
    )


def _image_parts(shape: ConvShape) -> tuple[int, int]:
    """(parts, rows of each) into which the sum over an image for the gradient of weights is cut."""
    rows = max(ROWS_PER_PART, -(-shape.size[0] // most_parts(shape)))
    return -(-shape.size[0] // rows), rows


def _program(
    conv: Conv, channels: int, tiles: Tiles
) -> tuple[Program, tuple[int, int, int], tuple[int, int, int]]:
    """(program, work-items, work-group) for a result of so many channels; no work-item computes
    groups of channels or a row in vain.
    """
    tiles.check(conv.shape.size)
    (height, width), blocks = conv.shape.size, -(-channels // VECTOR)
    pixels, groups, work_group = conv.blocking.direct
    if blocks % groups:
        pixels, groups, work_group = conv.blocking.direct_odd
    pixels = next(p for p in (pixels, 8, 4, 1) if p <= width)
    size = (-(-width // pixels), height, -(-blocks // groups))
    defines = {"KERNEL_SIZE": conv.shape.k, "PIXELS": pixels, "BLOCKS": groups}
    return conv.dev.program("layers/conv", **defines), size, work_group
