"""What all convolutions share: the layout of weights, and the sums of the parts of their gradients.

All convolutions are K x K (K = 1 or 3), with stride 1 and zero padding K // 2. conv_direct.py,
conv_local.py and conv_winograd.py compute them, each with the functions forward() and backward();
choice.py selects one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import PackedArrays
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, row_parts
from pp_cl.engine.layers.tiles import VECTOR

# A convolution computes its output, or the gradients of its inputs, weights and bias.
DIRECTIONS = ("forward", "backward")
# The parts of gradients take at most this many floats (64 MiB), or those of one part if larger.
PARTIAL_FLOATS = 1 << 24


@dataclass(frozen=True)
class ConvShape:
    """One direction of a convolution.

    direction: one of DIRECTIONS. k: side of the kernel. sources: channels of each input; two inputs
    are concatenated. co: output channels. size: (height, width) of the image.
    """

    direction: str
    k: int
    sources: tuple[int, ...]
    co: int
    size: tuple[int, int]

    @property
    def ci(self) -> int:
        """Input channels."""
        return sum(self.sources)

    @property
    def products(self) -> int:
        """Multiplications of weights by values for one pixel, counted as direct convolutions."""
        return self.k**2 * self.ci * self.co


@dataclass(frozen=True)
class Blocking:
    """Sizes that kernels are built and launched with. They change the speed, and the rounding of
    winograd_backward.cl, which sums `winograd_weights` tiles at a time.

    direct: (pixels of a row, groups of 16 output channels) that a work-item of direct.h computes,
    if their number is a multiple of that; direct_odd: the same otherwise. accumulators: float16
    sums of weights' gradients that a work-item keeps in registers. work_group: work-group size of
    direct convolutions, None = the launcher's default. winograd_groups: groups of 16 output
    channels that Winograd's kernels multiply together, if their number is a multiple of that.
    winograd: (tiles transformed at a time, tiles multiplied together) in them; winograd_narrow: the
    same for few channels (conv_winograd.NARROW). winograd_weights: tiles transformed at a time for
    the gradients of weights.
    """

    direct: tuple[int, int]
    direct_odd: tuple[int, int]
    accumulators: int
    work_group: tuple[int, int, int] | None
    winograd_groups: int = 2
    # More tiles at a time reuse transformed weights better, fewer leave more room in the caches.
    # The second number divides the first: with 2 groups of channels, 8 tiles take 16 of AVX-512's
    # 32 vectors, 12 take 24.
    winograd: tuple[int, int] = (64, 8)
    winograd_narrow: tuple[int, int] = (12, 12)
    winograd_weights: int = 32


@dataclass
class Conv:
    """One direction of a layer's convolution on a device.

    variant: a key of choice.VARIANTS, which computes it. weight, bias: the layer's, (ceil(CO/16),
    K, K, CI, 16) and (ceil(CO/16) * 16,) float32. work: the weights as the kernels read them, by
    default `weight`. partial: for the direction "backward", the parts of the gradients of the
    weights and biases. choice.work_table() gives the shapes of both. is_halved: True for the last
    layer, whose output is halved afterwards; backward() gets the gradient of the halved output.
    """

    dev: Device
    blocking: Blocking
    variant: str
    shape: ConvShape
    weight: Array
    bias: Array
    is_halved: bool = False
    work: Array = field(init=False)
    partial: Array = field(init=False)

    def __post_init__(self) -> None:
        self.work = self.weight

    def take(self, name: str, array: Array) -> None:
        """Use an array of choice.work_table(): "work" or "partial"."""
        if name == "work":
            self.work = array
        else:
            self.partial = array


def pack_weights(weight: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """(CO, CI, K, K) -> (ceil(CO / 16), K, K, CI, 16); output channels beyond CO are zero."""
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


def parts_shape(parts: int, shape: ConvShape) -> tuple[int, int, int, int]:
    """The shape of an array for a number of parts of the gradients of weights and biases."""
    return parts, -(-shape.co // VECTOR), shape.k**2 * shape.ci + 1, VECTOR


def most_parts(shape: ConvShape) -> int:
    """How many parts fit in memory, at least 1."""
    return max(1, PARTIAL_FLOATS // math.prod(parts_shape(1, shape)))


def first_float(array: Array) -> int:
    """The index of an array's first float in the whole of packed_arrays(); 0 if it has its own
    buffer.
    """
    data: Any = array.base_data
    return data.offset // array.dtype.itemsize


def mask_bits(masks: Sequence[bool]) -> int:
    """The argument `masked` of kernels: one bit for each source."""
    return sum(1 << i for i, is_masked in enumerate(masks) if is_masked)


class PartsRow(NamedTuple):
    """A row of the table of GradientParts, for one convolution: cl/layers/parts.h says what its
    columns are.
    """

    item: int
    sums: int
    blocks: int
    parts: int
    partial: int
    weight: int
    bias: int
    halved: int


def column_macros(prefix: str, row: Any) -> dict[str, int]:
    """The defines of kernels that read a table with these rows, a NamedTuple: the number of each
    column by its name.
    """
    return {f"{prefix}_{name.upper()}": number for number, name in enumerate(row._fields)}


PARTS_MACROS = column_macros("PARTS", PartsRow)


class GradientParts(NamedTuple):
    """The parts of the gradients of several convolutions' weights and biases, as kernels read them
    (cl/layers/parts.h). n: vectors of 16 in all gradients. table: (convolutions, 8) int32, a
    PartsRow for each. partial: (?,) float32, the parts.
    """

    n: int
    table: Array
    partial: Array


def gradient_parts(
    parts: Sequence[tuple[Conv, int]], table: PackedArrays, partial: Array
) -> GradientParts:
    """The parts that backward() of convolutions left in `partial`, (?,) float32, which contains
    each Conv.partial.

    parts: [(convolution, number of parts)]. table: holds the table that kernels read, until the
    next call with it.
    """
    rows, n = [], 0
    for conv, count in parts:
        _, blocks, sums, _ = conv.partial.shape
        arrays = conv.partial, conv.weight, conv.bias
        partial_at, weight, bias = (first_float(array) // VECTOR for array in arrays)
        rows.append(PartsRow(n, sums, blocks, count, partial_at, weight, bias, conv.is_halved))
        n += sums * blocks
    values = np.array(rows, np.int32)
    (sent,) = table.send([(values.shape, np.int32)], [values])
    return GradientParts(n, sent, partial)


def sum_parts(dev: Device, parts: GradientParts, grad_weights: Array, grad_biases: Array) -> None:
    """Overwrite the gradients of weights and biases with the sums of their parts, in order.

    grad_weights, grad_biases: (?,) float32; the gradients lie in them as Conv.weight and Conv.bias
    do in their arrays.
    """
    dev.program("layers/sum_parts", LANES=lanes(dev), **PARTS_MACROS).launch(
        "sum_parts",
        parts.n * row_parts(dev),
        n=parts.n,
        rows=len(parts.table),
        table=parts.table,
        partial=parts.partial,
        grad_weights=grad_weights,
        grad_biases=grad_biases,
    )
