"""Direct convolutions, of any channels, 1x1 and 3x3; and what all convolutions share: the layout of
weights, the cutting of work, checks.

All are convolutions K x K (K = 1 or 3) of stride 1 with zero padding K // 2. conv_winograd.py and
conv_local.py compute them in other ways; choice.py says which one is taken.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, row_parts
from pp_cl.engine.layers.tiles import SIDE, VECTOR, Tiles

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


Sources = tuple[Array, ...]
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


class DirectConv:
    """One direction of a convolution, whose kernels are conv.cl and conv_backward_weights.cl.

    work_shape: of the float32 array that it needs beside the layer's own: for FORWARD and
    BACKWARD_INPUT the weights as the kernels read them, which lay_out() writes, None where they
    read them as they are; for BACKWARD_WEIGHTS the parts of the sums. Its methods raise ValueError
    for arrays and tiles of other shapes.
    """

    def __init__(self, dev: Device, blocking: Blocking, shape: ConvShape):
        self.dev, self.blocking, self.shape = dev, blocking, shape
        self.work_shape = self._work_shape()

    def _work_shape(self) -> tuple[int, ...] | None:
        k, ci, co = self.shape.k, self.shape.ci, self.shape.co
        if self.shape.direction is Direction.FORWARD:
            return None
        if self.shape.direction is Direction.BACKWARD_INPUT:
            return packed_shape(k, co, ci)
        return parts_shape(self._parts(), k, ci, co)

    def laid_out(self, weight: Array) -> Array:
        """A layer's weights (ceil(CO/16), K, K, CI, 16) as the kernels read them: a new array, or
        itself where they read them as they are.
        """
        if self.work_shape is None:
            return weight
        array = self.dev.empty(self.work_shape)
        self.lay_out(self.dev, weight.reshape(-1), [(self.shape, 0, 0)], array)
        return array

    def scratch_floats(self) -> int:
        """Floats of the memory that the convolutions share."""
        return 0

    @staticmethod
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
        self, sources: Sources, weights: Array, bias: Array, out: Array, *, relu: bool, tiles: Tiles
    ) -> None:
        """out = convolution of the sources' concatenation + bias, then max(., 0) if relu.

        sources: one or two of (H, W, C1), (H, W, C2); weights: of lay_out(), else (ceil(CO/16), K,
        K, C1 + C2, 16); bias: (ceil(CO/16) * 16,); out: (H, W, CO), all float32; tiles: those of
        out to compute.
        """
        self._check(weights, tiles, bias)
        c1, *others = self.shape.sources
        self._launch(
            "forward",
            tiles,
            self.shape.co,
            self.shape.sources,
            c1=c1,
            c2=sum(others),
            co=self.shape.co,
            relu=relu,
            x=sources[0],
            x2=sources[-1],
            weight=weights,
            bias=bias,
            out=out,
        )

    def backward_input(
        self, weights: Array, grad_out: Array, grad_x: Array, *, mask: Array | None, tiles: Tiles
    ) -> None:
        """grad_x = gradient of the convolution's input, 0 where mask <= 0.

        weights: of lay_out(); grad_out: (H, W, CO), dL/dout before the ReLU; grad_x: (H, W, C);
        mask: (H, W, C), the input where it is a ReLU's output, so that grad_x is the gradient of
        the ReLU's input, or None; tiles: those of grad_x to compute.
        """
        self._check(weights, tiles)
        self._launch(
            "backward_input",
            tiles,
            self.shape.ci,
            (self.shape.co,),
            c=self.shape.ci,
            co=self.shape.co,
            masked=mask is not None,
            x=grad_x if mask is None else mask,
            flipped=weights,
            grad_out=grad_out,
            grad_x=grad_x,
        )

    def _launch(self, kernel, tiles, channels, inputs, **arguments):
        """Compute the tiles of a result of so many channels, of inputs of so many each."""
        program, size, work_group = self._program(channels)
        program.launch(
            f"conv_{kernel}",
            size,
            local=work_group,
            multiply_adds=self._multiply_adds(tiles),
            along=1,
            height=self.shape.size[0],
            width=self.shape.size[1],
            tile_count=tiles.count,
            **arguments,
        )

    def backward_weights(
        self, sources: Sources, grad_out: Array, partial: Array, *, tiles: Tiles
    ) -> int:
        """Write the gradients of forward(sources, ...)'s weights and biases, given dL/dout (H, W,
        CO) before the ReLU, as sums of the image's parts, which sum_parts() sums; returns how many.

        partial: of work_shape. tiles: those of grad_out to sum, each as often as it counts. The
        order of the sums depends on the shapes alone, with other variants on the number of tiles
        too.
        """
        self._check(partial, tiles)
        k, co, (height, width) = self.shape.k, self.shape.co, self.shape.size
        (parts, rows), first = image_parts(self.shape), 0
        for source, c in zip(sources, self.shape.sources, strict=True):
            # input channels of a work-item, whose sums, k for each, fit the registers
            group = next(
                n for n in (16, 8, 4, 2, 1) if n * k <= self.blocking.accumulators and c % n == 0
            )
            self.dev.program("layers/conv_backward_weights", KERNEL_SIZE=k, CI_GROUP=group).launch(
                "conv_backward_weights",
                (c // group * k, -(-co // VECTOR), parts),
                local=self.blocking.work_group,
                multiply_adds=height * width * k**2 * c * co,
                along=2,
                height=height,
                width=width,
                c=c,
                co=co,
                first=first,
                ci=self.shape.ci,
                rows=rows,
                x=source,
                grad_out=grad_out,
                tile_count=tiles.count,
                partial=partial,
            )
            first += c
        return parts

    def _check(self, work: Array, tiles: Tiles, bias: Array | None = None) -> None:
        """Raise ValueError for weights or parts, tiles or a bias of another shape."""
        ci, co = self.shape.ci, self.shape.co
        expected = self.work_shape or packed_shape(self.shape.k, ci, co)
        biases = -(-co // VECTOR) * VECTOR
        if work.shape != expected or (bias is not None and bias.shape != (biases,)):
            raise ValueError(
                f"convolution of {ci} to {co} channels: weights {work.shape}, expected {expected},"
                f" and {biases} biases"
            )
        if tiles.size != self.shape.size:
            raise ValueError(f"tiles of {tiles.size} for a feature map of {self.shape.size}")

    def _parts(self):
        """Into how many parts the sum over an image for the gradient of weights is cut."""
        return image_parts(self.shape)[0]

    def _multiply_adds(self, tiles):
        return tiles.number * SIDE**2 * self.shape.k**2 * self.shape.ci * self.shape.co

    def _program(self, channels):
        """(program, global size, work-group) for a result of so many channels; no work-item
        computes groups of channels or a row in vain.
        """
        (height, width), blocks = self.shape.size, -(-channels // VECTOR)
        pixels, groups, work_group = self.blocking.direct
        if blocks % groups:
            pixels, groups, work_group = self.blocking.direct_odd
        pixels = next(p for p in (pixels, 8, 4, 1) if p <= width)
        size = (-(-width // pixels), height, -(-blocks // groups))
        defines = {"KERNEL_SIZE": self.shape.k, "PIXELS": pixels, "BLOCKS": groups}
        return self.dev.program("layers/conv", **defines), size, work_group


def image_parts(shape: ConvShape) -> tuple[int, int]:
    """(parts, rows of each) into which the sum over an image for the gradient of weights is cut."""
    rows = max(ROWS_PER_PART, -(-shape.size[0] // most_parts(shape)))
    return -(-shape.size[0] // rows), rows


def most_parts(shape: ConvShape) -> int:
    """The parts for which there is memory."""
    return max(1, PARTIAL_FLOATS // math.prod(parts_shape(1, shape.k, shape.ci, shape.co)))
