"""What the three convolution variants share: the layout of weights, the sizes of work-items
(Blocking) and checks of shapes.

conv_direct.py, conv_winograd.py and conv_local.py have the same five functions: scratch_floats,
lay_out, forward, backward_input and backward_weights, which conv_direct.py describes. All are
convolutions K x K (K = 1 or 3) of stride 1 with zero padding K // 2; choice.py says which of them
computes one.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, row_parts
from pp_cl.layers.tiles import VECTOR


class Direction(Enum):
    """What of a convolution is computed. The values are the words in stored tunings and in bench
    rows.
    """

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
    work_group: its work-group, None = the launcher's default. winograd: (tiles transformed at a
    time, tiles multiplied together) of winograd.cl; winograd_narrow: the same for few channels
    (conv_winograd.NARROW). winograd_weights: tiles transformed at a time by
    winograd_backward_weights.cl.
    """

    direct: tuple[int, int, tuple[int, int, int]]
    direct_odd: tuple[int, int, tuple[int, int, int]]
    accumulators: int
    work_group: tuple[int, int, int] | None
    # More tiles at a time use the transformed weights better, fewer leave more room in the caches.
    # The second number divides the first: with 2 x 16 channels, 8 take 16 of AVX-512's 32 vectors,
    # 12 take 24.
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


def check_weights(sources: tuple[Array, ...], weight: Array, bias: Array, out: Array) -> None:
    """Raise ValueError unless weight (ceil(CO/16), K, K, CI, 16) and bias (ceil(CO/16) * 16,), or
    their gradients, are those of a convolution of the sources (H, W, C1), (H, W, C2) to out (H, W,
    CO).
    """
    co, channels = out.shape[2], [source.shape[2] for source in sources]
    blocks = -(-co // VECTOR)
    expected = blocks, sum(channels), (blocks * VECTOR,)
    if (weight.shape[0], weight.shape[3], bias.shape) != expected:
        raise ValueError(
            f"convolution of {' + '.join(map(str, channels))} to {co} channels: weight is"
            f" {weight.shape}, bias {bias.shape}"
        )


def sum_parts(
    dev: Device, partial: Array, grad_weight: Array, grad_bias: Array, *, parts: int
) -> None:
    """grad_weight (blocks, K, K, CI, 16) and grad_bias (blocks * 16,) = sums, in order, of the
    parts of an image, partial (parts, blocks, K * K * CI + 1, 16) or longer.
    """
    blocks, k, _, ci, _ = grad_weight.shape
    dev.program("layers/conv_backward_weights", KERNEL_SIZE=k, LANES=lanes(dev)).launch(
        "conv_sum_parts",
        (row_parts(dev) * (k * k * ci + 1), blocks),
        per_block=k * k * ci,
        blocks=blocks,
        parts=parts,
        partial=partial,
        grad_weight=grad_weight,
        grad_bias=grad_bias,
    )
