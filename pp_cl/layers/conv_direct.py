"""Direct convolutions, of any channels, 1x1 and 3x3; and what all convolutions share: the layout of
weights, the cutting of work, checks.

conv_winograd.py and conv_local.py have the same six functions: scratch_floats, laid_out_floats,
lay_out, forward, backward_input and backward_weights. All are convolutions K x K (K = 1 or 3) of
stride 1 with zero padding K // 2; choice.py says which module computes one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, row_parts
from pp_cl.layers.tiles import SIDE, VECTOR, Tiles, checked_tiles

# Rows of the image that one work-item sums for the gradient of the weights: few enough to stay in a
# core's cache, and enough parts for all cores.
ROWS_PER_PART = 8
# The partial sums take at most this many floats (64 MiB), or one part if that is larger.
PARTIAL_FLOATS = 1 << 24
# Weights to lay out: first float in the weights and in what they become, shape, first input channel
# (None: for the forward pass), input channels and output channels that a pass computes.
Layout = tuple[int, int, tuple[int, ...], Any, int, int]
# Gradients of weights to sum: shape, parts, first float of the parts, of the weights' gradient and
# of the biases'.
Sums = tuple[tuple[int, ...], int, int, int, int]
# Names of the memory that convolutions work in.
FLIPPED, PARTIAL = "flipped weights", "parts of the weights' gradients"


class Direction(Enum):
    """What of a convolution is computed. The values are the words in rows of `pp-cl bench`."""

    FORWARD = "forward"
    BACKWARD_INPUT = "input"  # gradient of the input
    BACKWARD_WEIGHTS = "weights"  # gradients of weights and bias


@dataclass(frozen=True)
class Blocking:
    """Sizes that kernels are built and launched with. They change speed, and the rounding of
    winograd_backward_weights.cl, which sums `winograd_weights` tiles at a time.

    direct: (pixels of a row, groups of 16 output channels, work-group) of a work-item of conv.cl,
    where the groups come in multiples of that number; direct_odd: the same for other channels.
    accumulators: float16 sums that a work-item of conv_backward_weights.cl keeps in registers;
    work_group: its work-group, None = the launcher's default. winograd_groups: groups of 16 output
    channels that winograd.cl multiplies together, where the groups come in multiples of that
    number. winograd: (tiles transformed at a time, tiles multiplied together) there;
    winograd_narrow: the same for few channels (conv_winograd.NARROW). winograd_weights: tiles
    transformed at a time by winograd_backward_weights.cl.
    """

    direct: tuple[int, int, tuple[int, int, int]]
    direct_odd: tuple[int, int, tuple[int, int, int]]
    accumulators: int
    work_group: tuple[int, int, int] | None
    winograd_groups: int = 2
    # More tiles at a time use the transformed weights better, fewer leave more room in the caches.
    # The second number divides the first: with 2 groups of channels, 8 take 16 of AVX-512's 32
    # vectors, 12 take 24.
    winograd: tuple[int, int] = (64, 8)
    winograd_narrow: tuple[int, int] = (12, 12)
    winograd_weights: int = 32


def pack_weights(weight: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """(CO, CI, K, K) -> (ceil(CO / 16), K, K, CI, 16), output channels beyond CO zero."""
    co, ci, k, _ = weight.shape
    packed = np.zeros((-(-co // VECTOR) * VECTOR, ci, k, k), dtype)
    packed[:co] = weight
    return np.ascontiguousarray(packed.reshape(-1, VECTOR, ci, k, k).transpose(0, 3, 4, 2, 1))


def unpack_weights(packed: np.ndarray, co: int) -> np.ndarray:
    """The inverse of pack_weights: (CO, CI, K, K)."""
    blocks, k, _, ci, _ = packed.shape
    return packed.transpose(0, 4, 3, 1, 2).reshape(blocks * VECTOR, ci, k, k)[:co]


def pack_bias(bias: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """(CO,) -> (ceil(CO / 16) * 16,), padded with zeros."""
    return np.pad(np.asarray(bias, dtype), (0, -len(bias) % VECTOR))


def check_weights(
    sources: tuple[Array, ...], weight_shape: tuple, out: Array, bias: Array | None = None
) -> None:
    """Raise ValueError unless weights (ceil(CO/16), K, K, CI, 16), and a bias (ceil(CO/16) * 16,),
    are those of a convolution of the sources (H, W, C1), (H, W, C2) to out (H, W, CO).
    """
    co, channels = out.shape[2], [source.shape[2] for source in sources]
    blocks = -(-co // VECTOR)
    of_bias = (blocks * VECTOR,) if bias is None else bias.shape
    expected = blocks, sum(channels), (blocks * VECTOR,)
    if (weight_shape[0], weight_shape[3], of_bias) != expected:
        raise ValueError(
            f"convolution of {' + '.join(map(str, channels))} to {co} channels: weight is"
            f" {weight_shape}, bias {of_bias}"
        )


def table_of_sums(jobs: Sequence[Sums]) -> tuple[list[tuple[int, ...]], int]:
    """(rows, number of sums of 16) of the table that sum_parts() takes."""
    rows, n = [], 0
    for (blocks, k, _, ci, _), parts, *places in jobs:
        rows.append((n, k * k * ci + 1, blocks, parts, *(place // VECTOR for place in places), 0))
        n += (k * k * ci + 1) * blocks
    return rows, n


def sum_parts(
    dev: Device, table: Array, n: int, partial: Array, grad_weights: Array, grad_biases: Array
) -> None:
    """Gradients = sums, in order, of the parts of an image, of all weights in one launch.

    table, n: of table_of_sums(). partial, grad_weights, grad_biases: (?,) float32; of each weights
    (parts, blocks, K * K * CI + 1, 16), (blocks, K, K, CI, 16) and (blocks, 16).
    """
    dev.program("layers/conv_backward_weights", LANES=lanes(dev)).launch(
        "conv_sum_parts",
        n * row_parts(dev),
        n=n,
        rows=len(table),
        table=table,
        partial=partial,
        grad_weights=grad_weights,
        grad_biases=grad_biases,
    )


def scratch_floats(
    _dev: Device,
    _blocking: Blocking,
    direction: Direction,
    height: int,
    weight_shape: tuple,
    c: int,
) -> dict[str, int]:
    """{name of Device.scratch(): floats} for an image `height` high.

    weight_shape: (ceil(CO/16), K, K, CI, 16); c: input channels, of a gradient of the input those
    of the one source.
    """
    if direction is Direction.BACKWARD_WEIGHTS:
        return {PARTIAL: partial_floats(height, weight_shape)}
    if direction is Direction.BACKWARD_INPUT:
        return {FLIPPED: math.prod(_flipped_shape(weight_shape, c, weight_shape[0] * VECTOR))}
    return {}


def laid_out_floats(direction: Direction, weight_shape: tuple, c: int) -> int:
    """Floats of a layer's weights as the kernels of FORWARD or BACKWARD_INPUT read them; 0 where
    they read them as they are. weight_shape, c: as scratch_floats() takes them.
    """
    if direction is Direction.FORWARD:
        return 0
    return math.prod(_flipped_shape(weight_shape, c, weight_shape[0] * VECTOR))


def lay_out(dev: Device, weights: Array, jobs: Sequence[Layout], laid_out: Array) -> None:
    """Lay out weights in one launch: those of input gradients with the kernel mirrored and the
    roles of input and output channels exchanged, (ceil(c/16), K, K, co, 16).

    weights, laid_out: (?,) float32.
    """
    rows, n = [], 0
    for start, target, (_, k, _, ci, _), first, c, co in jobs:
        blocks = -(-c // VECTOR)
        taken = min(ci - first, blocks * VECTOR)
        rows.append((n, k * k, co, taken, first, ci, start, target // VECTOR))
        n += co * k * k * blocks
    dev.program("layers/conv_backward_weights", LANES=lanes(dev)).launch(
        "conv_flip_weights",
        n,
        n=n,
        rows=len(rows),
        table=dev.constant(rows),
        weights=weights,
        flipped=laid_out,
    )


def forward(
    dev: Device,
    blocking: Blocking,
    sources: tuple[Array, ...],
    weight: Array,
    bias: Array,
    out: Array,
    *,
    relu: bool,
    tiles: Tiles | None = None,
    laid_out: Array | None = None,
) -> None:
    """out = convolution of the sources' concatenation + bias, then max(., 0) if relu.

    sources: one or two of (H, W, C1), (H, W, C2); weight: (ceil(CO/16), K, K, C1 + C2, 16); bias:
    (ceil(CO/16) * 16,); out: (H, W, CO), all float32; tiles: those of out to compute, None = all;
    laid_out: of lay_out(), None = computed here if it is needed. Raises ValueError when shapes
    do not fit together.
    """
    height, width, co = out.shape
    check_weights(sources, weight.shape, out, bias)
    channels = [source.shape[2] for source in sources]
    tiles = checked_tiles(dev, tiles, height, width)
    program, size, work_group = _program(dev, blocking, weight.shape[1], out.shape)
    program.launch(
        "conv_forward",
        size,
        local=work_group,
        multiply_adds=tiles.number * SIDE**2 * weight.shape[1] ** 2 * sum(channels) * co,
        along=1,
        height=height,
        width=width,
        c1=channels[0],
        c2=sum(channels[1:]),
        co=co,
        relu=relu,
        x=sources[0],
        x2=sources[-1],
        weight=weight,
        bias=bias,
        out=out,
        tile_count=tiles.count,
    )


def backward_input(
    dev: Device,
    blocking: Blocking,
    weight: Array,
    first: int,
    grad_out: Array,
    grad_x: Array,
    *,
    mask: Array | None,
    tiles: Tiles | None = None,
    laid_out: Array | None = None,
) -> None:
    """grad_x = gradient of a convolution's input, 0 where mask <= 0.

    weight: of forward(); first: its input channel that is grad_x's first; grad_out: (H, W, CO),
    dL/dout before the ReLU; grad_x: (H, W, C); mask: (H, W, C), the input where it is a ReLU's
    output, so that grad_x is the gradient of the ReLU's input, or None; tiles: those of grad_x to
    compute, None = all; laid_out: of lay_out(), None = computed here. Raises ValueError when shapes
    do not fit together.
    """
    height, width, c = grad_x.shape
    flipped = flipped_weights(dev, weight, first, c, grad_out.shape[2], laid_out)
    tiles = checked_tiles(dev, tiles, height, width)
    program, size, work_group = _program(dev, blocking, flipped.shape[1], grad_x.shape)
    program.launch(
        "conv_backward_input",
        size,
        local=work_group,
        multiply_adds=tiles.number * SIDE**2 * flipped.shape[1] ** 2 * grad_out.shape[2] * c,
        along=1,
        height=height,
        width=width,
        c=c,
        co=grad_out.shape[2],
        masked=mask is not None,
        x=grad_x if mask is None else mask,
        flipped=flipped,
        grad_out=grad_out,
        grad_x=grad_x,
        tile_count=tiles.count,
    )


def backward_weights(
    dev: Device,
    blocking: Blocking,
    sources: tuple[Array, ...],
    grad_out: Array,
    weight_shape: tuple,
    partial: Array,
    *,
    tiles: Tiles | None = None,
) -> int:
    """Write the gradients of forward(sources, ...)'s weights and biases, given dL/dout (H, W, CO)
    before the ReLU, as sums of the image's parts, which sum_parts() sums.

    weight_shape: of forward()'s weight. partial: (?,) float32 of scratch_floats()[PARTIAL]. tiles:
    those of grad_out to sum, each as often as it counts, None = all, once. The order of the sums
    depends on the shapes alone. Returns how many parts. Raises ValueError when shapes do not fit
    together.
    """
    height, width, co = grad_out.shape
    blocks, k, _, ci, _ = weight_shape
    check_weights(sources, weight_shape, grad_out)
    tiles = checked_tiles(dev, tiles, height, width)
    parts, rows = image_parts(height, weight_shape)
    first = 0
    for source in sources:
        c = source.shape[2]
        program, group = _weights_program(dev, blocking, k, c)
        program.launch(
            "conv_backward_weights",
            (c // group * k, blocks, parts),
            local=blocking.work_group,
            multiply_adds=height * width * k**2 * c * co,
            along=2,
            height=height,
            width=width,
            c=c,
            co=co,
            first=first,
            ci=ci,
            rows=rows,
            x=source,
            grad_out=grad_out,
            tile_count=tiles.count,
            partial=partial,
        )
        first += c
    return parts


def flipped_weights(
    dev: Device, weight: Array, first: int, c: int, co: int, laid_out: Array | None
) -> Array:
    """(ceil(c/16), K, K, co, 16): `laid_out` or, where it is None, scratch that lay_out() fills.

    weight: (ceil(CO/16), K, K, CI, 16); c: input channels taken from `first` on, CI - first or
    less, a multiple of 16 unless they reach CI.
    """
    shape = _flipped_shape(weight.shape, c, co)
    if laid_out is None:
        laid_out = dev.scratch(FLIPPED, math.prod(shape))
        lay_out(dev, weight.reshape(-1), [(0, 0, weight.shape, first, c, co)], laid_out)
    return laid_out[: math.prod(shape)].reshape(shape)


def partial_floats(height: int, weight_shape: tuple) -> int:
    """Floats of PARTIAL that backward_weights() needs for an image `height` high."""
    blocks, k, _, ci, _ = weight_shape
    return image_parts(height, weight_shape)[0] * blocks * (k * k * ci + 1) * VECTOR


def image_parts(height: int, weight_shape: tuple) -> tuple[int, int]:
    """(parts, rows of each) into which the sum over an image `height` high is cut."""
    blocks, k, _, ci, _ = weight_shape
    limit = max(1, PARTIAL_FLOATS // (blocks * (k * k * ci + 1) * VECTOR))
    rows = max(ROWS_PER_PART, -(-height // limit))
    return -(-height // rows), rows


def _flipped_shape(weight_shape, c, co):
    return -(-c // VECTOR), *weight_shape[1:3], co, VECTOR


def _program(dev, blocking, k, shape):
    """(program, global size, work-group) for a result of shape (H, W, C); no work-item computes
    groups of channels or a row in vain.
    """
    height, width, channels = shape
    pixels, groups, work_group = blocking.direct
    if -(-channels // VECTOR) % groups:
        pixels, groups, work_group = blocking.direct_odd
    pixels = next(p for p in (pixels, 8, 4, 1) if p <= width)
    size = (-(-width // pixels), height, -(-channels // (VECTOR * groups)))
    return dev.program("layers/conv", KERNEL_SIZE=k, PIXELS=pixels, BLOCKS=groups), size, work_group


def _weights_program(dev, blocking, k, channels):
    """(program, input channels of one work-item): a divisor of the channels whose sums, k for each
    channel, fit the registers.
    """
    group = next(
        n for n in (16, 8, 4, 2, 1) if n * k <= blocking.accumulators and channels % n == 0
    )
    return dev.program("layers/conv_backward_weights", KERNEL_SIZE=k, CI_GROUP=group), group
