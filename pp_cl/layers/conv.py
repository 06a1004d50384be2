"""Direct convolutions K x K (K = 1 or 3), stride 1, zero padding K // 2, and the layout of their
weights.
"""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.blocking import Blocking
from pp_cl.layers.tiles import LANES, SIDE, Tiles, checked_tiles


def pack_weights(weight: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """(CO, CI, K, K) -> (ceil(CO / 16), K, K, CI, 16), output channels beyond CO zero."""
    co, ci, k, _ = weight.shape
    packed = np.zeros((-(-co // LANES) * LANES, ci, k, k), dtype)
    packed[:co] = weight
    return np.ascontiguousarray(packed.reshape(-1, LANES, ci, k, k).transpose(0, 3, 4, 2, 1))


def unpack_weights(packed: np.ndarray, co: int) -> np.ndarray:
    """The inverse of pack_weights: (CO, CI, K, K)."""
    blocks, k, _, ci, _ = packed.shape
    return packed.transpose(0, 4, 3, 1, 2).reshape(blocks * LANES, ci, k, k)[:co]


def pack_bias(bias: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """(CO,) -> (ceil(CO / 16) * 16,), padded with zeros."""
    return np.pad(np.asarray(bias, dtype), (0, -len(bias) % LANES))


def conv_forward(
    dev: Device,
    sources: tuple[Array, ...],
    weight: Array,
    bias: Array,
    *,
    out: Array,
    relu: bool,
    blocking: Blocking,
    tiles: Tiles | None = None,
) -> None:
    """out = convolution of the sources' concatenation + bias, then max(., 0) if relu.

    sources: one or two of (H, W, C1), (H, W, C2); weight: (ceil(CO/16), K, K, C1 + C2, 16); bias:
    (ceil(CO/16) * 16,); out: (H, W, CO), all float32; tiles: those of out to compute, None = all.
    Raises ValueError when shapes do not fit together.
    """
    height, width, co = out.shape
    check_forward(sources, weight, bias, out)
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


def conv_backward_input(
    dev: Device,
    flipped: Array,
    grad_out: Array,
    grad_x: Array,
    *,
    mask: Array | None,
    blocking: Blocking,
    tiles: Tiles | None = None,
) -> None:
    """grad_x = gradient of a convolution's input, 0 where mask <= 0.

    flipped: (ceil(C/16), K, K, CO, 16) from conv_backward_weights.flip_weights; grad_out: (H, W,
    CO); grad_x: (H, W, C); mask: (H, W, C), the input where it is a ReLU's output, so that grad_x
    is the gradient of the ReLU's input, or None; tiles: those of grad_x to compute, None = all.
    Raises ValueError when shapes do not fit together.
    """
    height, width, c = grad_x.shape
    check_flipped(flipped, grad_x)
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


def check_forward(sources: tuple[Array, ...], weight: Array, bias: Array, out: Array) -> None:
    """Raise ValueError unless weight and bias are those of conv_forward() for these arrays."""
    co, channels = out.shape[2], [source.shape[2] for source in sources]
    blocks = -(-co // LANES)
    if (weight.shape[0], weight.shape[3]) != (blocks, sum(channels)) or bias.shape != (
        blocks * LANES,
    ):
        raise ValueError(
            f"convolution of {' + '.join(map(str, channels))} to {co} channels: weight is"
            f" {weight.shape}, bias {bias.shape}"
        )


def check_flipped(flipped: Array, grad_x: Array) -> None:
    """Raise ValueError unless these are conv_backward_input()'s weights for so many channels."""
    c = grad_x.shape[2]
    if flipped.shape[0] != -(-c // LANES):
        raise ValueError(f"input gradient of {c} channels: flipped weights are {flipped.shape}")


def _program(dev, blocking, k, shape):
    """(program, global size, work-group) for a result of shape (H, W, C)."""
    height, width, channels = shape
    pixels, groups, work_group = blocking.of_direct(width, channels)
    size = (-(-width // pixels), height, -(-channels // (LANES * groups)))
    return dev.program("layers/conv", KERNEL_SIZE=k, PIXELS=pixels, BLOCKS=groups), size, work_group
