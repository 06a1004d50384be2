"""Direct convolutions, of any channels, 1x1 and 3x3; and what all convolutions share: the layout of
weights, the cutting of work, checks.

conv_winograd.py and conv_local.py have the same six functions: work_shape, scratch_floats, lay_out,
forward, backward_input and backward_weights. All are convolutions K x K (K = 1 or 3) of stride 1
with zero padding K // 2; choice.py says which module computes one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

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


class Direction(Enum):
    """What of a convolution is computed. The values are the words in rows of `pp-cl bench`."""

    FORWARD = "forward"
    BACKWARD_INPUT = "input"  # gradient of the input
    BACKWARD_WEIGHTS = "weights"  # gradients of weights and bias


@dataclass(frozen=True)
class ConvShape:
    """One direction of a convolution.

    k: side of the kernel. sources: channels of each input. co: output channels. size: (height,
    width) of the image. source: index of the input whose gradient is computed, None in the other
    directions.
    """

    direction: Direction
    k: int
    sources: tuple[int, ...]
    co: int
    size: tuple[int, int]
    source: int | None = None

    @property
    def ci(self) -> int:
        """Input channels; of a gradient of the input, those of its one source."""
        return sum(self.sources) if self.source is None else self.sources[self.source]

    @property
    def first(self) -> int:
        """The input channel of the weights that is the first of `ci`."""
        return sum(self.sources[: self.source or 0])


# Weights to lay out: for which pass, their first float, and the first float of what they become.
Layout = tuple[ConvShape, int, int]
# Parts of gradients to sum: the shape of the array that they lie in, how many, the first float of
# that array, of the weights' gradient and of the biases'.
Sums = tuple[tuple[int, ...], int, int, int, int]


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


def packed_shape(k: int, ci: int, co: int) -> tuple[int, int, int, int, int]:
    """The shape of pack_weights()."""
    return -(-co // VECTOR), k, k, ci, VECTOR


def parts_shape(parts: int, k: int, ci: int, co: int) -> tuple[int, int, int, int]:
    """The shape of an array for so many parts of the gradients of weights and biases."""
    return parts, -(-co // VECTOR), k * k * ci + 1, VECTOR


def check_shape(
    channels: Sequence[int], co: int, found: Array, expected: tuple, bias: Array | None = None
) -> None:
    """Raise ValueError unless the weights, or parts of their gradients, `found` are those of a
    convolution from these channels to `co`, which have the shape `expected`, and so the bias.
    """
    of_bias = (-(-co // VECTOR) * VECTOR,)
    if found.shape != expected or (bias is not None and bias.shape != of_bias):
        raise ValueError(
            f"convolution of {' + '.join(map(str, channels))} to {co} channels: weights"
            f" {found.shape}, expected {expected}"
            + (f", bias {bias.shape}, expected {of_bias}" if bias is not None else "")
        )


def table_of_sums(jobs: Sequence[Sums]) -> tuple[list[tuple[int, ...]], int]:
    """(rows, number of sums of 16) of the table that sum_parts() takes."""
    rows, n = [], 0
    for (_, blocks, sums, _), parts, *places in jobs:
        rows.append((n, sums, blocks, parts, *(place // VECTOR for place in places), 0))
        n += sums * blocks
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


def work_shape(shape: ConvShape) -> tuple[int, ...] | None:
    """The shape of the float32 array that a direction needs beside the layer's own: for FORWARD and
    BACKWARD_INPUT the weights as the kernels read them, which lay_out() writes, None where they
    read them as they are; for BACKWARD_WEIGHTS the parts of the sums.
    """
    if shape.direction is Direction.FORWARD:
        return None
    if shape.direction is Direction.BACKWARD_INPUT:
        return packed_shape(shape.k, shape.co, shape.ci)
    sizes = shape.k, shape.ci, shape.co
    return parts_shape(image_parts(shape.size[0], *sizes)[0], *sizes)


def scratch_floats(_dev: Device, _blocking: Blocking, _shape: ConvShape) -> int:
    """Floats of Device.scratch() that the kernels of a direction take."""
    return 0


def lay_out(dev: Device, weights: Array, jobs: Sequence[Layout], laid_out: Array) -> None:
    """Lay out weights in one launch: those of input gradients with the kernel mirrored and the
    roles of input and output channels exchanged, (ceil(c/16), K, K, co, 16).

    weights, laid_out: (?,) float32.
    """
    rows, n = [], 0
    for shape, start, target in jobs:
        blocks, ci, taps = -(-shape.ci // VECTOR), sum(shape.sources), shape.k**2
        taken = min(ci - shape.first, blocks * VECTOR)
        rows.append((n, taps, shape.co, taken, shape.first, ci, start, target // VECTOR))
        n += shape.co * taps * blocks
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
    weights: Array,
    bias: Array,
    out: Array,
    *,
    relu: bool,
    tiles: Tiles | None = None,
) -> None:
    """out = convolution of the sources' concatenation + bias, then max(., 0) if relu.

    sources: one or two of (H, W, C1), (H, W, C2); weights: as work_shape() says, else
    (ceil(CO/16), K, K, C1 + C2, 16); bias: (ceil(CO/16) * 16,); out: (H, W, CO), all float32;
    tiles: those of out to compute, None = all. Raises ValueError when shapes do not fit together.
    """
    height, width, co = out.shape
    k, channels = weights.shape[1], [source.shape[2] for source in sources]
    check_shape(channels, co, weights, packed_shape(k, sum(channels), co), bias)
    tiles = checked_tiles(dev, tiles, height, width)
    program, size, work_group = _program(dev, blocking, k, out.shape)
    program.launch(
        "conv_forward",
        size,
        local=work_group,
        multiply_adds=tiles.number * SIDE**2 * k**2 * sum(channels) * co,
        along=1,
        height=height,
        width=width,
        c1=channels[0],
        c2=sum(channels[1:]),
        co=co,
        relu=relu,
        x=sources[0],
        x2=sources[-1],
        weight=weights,
        bias=bias,
        out=out,
        tile_count=tiles.count,
    )


def backward_input(
    dev: Device,
    blocking: Blocking,
    weights: Array,
    grad_out: Array,
    grad_x: Array,
    *,
    mask: Array | None,
    tiles: Tiles | None = None,
) -> None:
    """grad_x = gradient of a convolution's input, 0 where mask <= 0.

    weights: as work_shape() says; grad_out: (H, W, CO), dL/dout before the ReLU; grad_x: (H, W, C);
    mask: (H, W, C), the input where it is a ReLU's output, so that grad_x is the gradient of the
    ReLU's input, or None; tiles: those of grad_x to compute, None = all. Raises ValueError when
    shapes do not fit together.
    """
    height, width, c = grad_x.shape
    k, co = weights.shape[1], grad_out.shape[2]
    check_shape([c], co, weights, packed_shape(k, co, c))
    tiles = checked_tiles(dev, tiles, height, width)
    program, size, work_group = _program(dev, blocking, k, grad_x.shape)
    program.launch(
        "conv_backward_input",
        size,
        local=work_group,
        multiply_adds=tiles.number * SIDE**2 * k**2 * co * c,
        along=1,
        height=height,
        width=width,
        c=c,
        co=co,
        masked=mask is not None,
        x=grad_x if mask is None else mask,
        flipped=weights,
        grad_out=grad_out,
        grad_x=grad_x,
        tile_count=tiles.count,
    )


def backward_weights(
    dev: Device,
    blocking: Blocking,
    sources: tuple[Array, ...],
    grad_out: Array,
    partial: Array,
    *,
    tiles: Tiles | None = None,
) -> int:
    """Write the gradients of forward(sources, ...)'s weights and biases, given dL/dout (H, W, CO)
    before the ReLU, as sums of the image's parts, which sum_parts() sums.

    partial: as work_shape() says. tiles: those of grad_out to sum, each as often as it counts, None
    = all, once. The order of the sums depends on the shapes alone. Returns how many parts. Raises
    ValueError when shapes do not fit together.
    """
    height, width, co = grad_out.shape
    channels = [source.shape[2] for source in sources]
    ci = sum(channels)
    k = math.isqrt((partial.shape[2] - 1) // ci)
    parts, rows = image_parts(height, k, ci, co)
    check_shape(channels, co, partial, parts_shape(parts, k, ci, co))
    tiles = checked_tiles(dev, tiles, height, width)
    first = 0
    for source, c in zip(sources, channels, strict=True):
        program, group = _weights_program(dev, blocking, k, c)
        program.launch(
            "conv_backward_weights",
            (c // group * k, -(-co // VECTOR), parts),
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


def image_parts(height: int, k: int, ci: int, co: int) -> tuple[int, int]:
    """(parts, rows of each) into which the sum over an image `height` high is cut."""
    limit = max(1, PARTIAL_FLOATS // math.prod(parts_shape(1, k, ci, co)))
    rows = max(ROWS_PER_PART, -(-height // limit))
    return -(-height // rows), rows


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
