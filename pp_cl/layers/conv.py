"""Convolutions K x K (K = 1 or 3), stride 1, zero padding K // 2, and the layout of their
weights.
"""

import numpy as np

from pp_cl.layers.conv_local import local_program
from pp_cl.layers.tiles import LANES, checked_tiles


def pack_weights(weight, dtype=np.float32):
    """(CO, CI, K, K) numpy array -> (ceil(CO / 16), K, K, CI, 16), output channels beyond CO
    zero.
    """
    co, ci, k, _ = weight.shape
    packed = np.zeros((-(-co // LANES) * LANES, ci, k, k), dtype)
    packed[:co] = weight
    return np.ascontiguousarray(packed.reshape(-1, LANES, ci, k, k).transpose(0, 3, 4, 2, 1))


def unpack_weights(packed, co):
    """The inverse of pack_weights: (CO, CI, K, K)."""
    blocks, k, _, ci, _ = packed.shape
    return packed.transpose(0, 4, 3, 1, 2).reshape(blocks * LANES, ci, k, k)[:co]


def pack_bias(bias, dtype=np.float32):
    """(CO,) numpy array -> (ceil(CO / 16) * 16,), padded with zeros."""
    return np.pad(np.asarray(bias, dtype), (0, -len(bias) % LANES))


def shipped_tiling(dev, channels_out):
    """(TILE, BLOCKS, work-group) of cl/layers/conv.cl for wide images, as shipped.

    A CPU core has 32 vector registers. Where the blocks of 16 channels pair up, two share each
    input value and take 8 pixels: 16 accumulators and 6 weights; else one takes 12. A GPU's
    work-item has about 255 scalar registers: 4 pixels.
    """
    if not dev.is_cpu:
        return 4, 1, (16, 4, 1)
    return (12, 1, (1, 1, 1)) if -(-channels_out // LANES) % 2 else (8, 2, (1, 1, 1))


def tiling(dev, width, channels_out):
    """(TILE, BLOCKS, work-group) for an image `width` wide: as tuned for the device, else as
    shipped.
    """
    tile, blocks, local = dev.tile_shapes.get("direct") or shipped_tiling(dev, channels_out)
    if -(-channels_out // LANES) % blocks:
        tile, blocks, local = shipped_tiling(dev, channels_out)
    return next(t for t in (tile, 8, 4, 1) if t <= width), blocks, tuple(local)


def conv_forward(dev, x, weight, bias, out, relu, x2=None, tiles=None, local_memory=False):
    """out = convolution of [x, x2] + bias, then max(., 0) if relu.

    x: (H, W, C1), x2: None or (H, W, C2); weight: (ceil(CO/16), K, K, C1 + C2, 16); bias:
    (ceil(CO/16) * 16,); out: (H, W, CO), all float32; tiles: tiles.Tiles of out that are written,
    None = all; local_memory: by cl/layers/conv_local.cl, which takes 3x3 kernels and channels in
    multiples of 16. Raises ValueError when shapes do not fit together.
    """
    height, width, co = out.shape
    c1, c2 = x.shape[2], 0 if x2 is None else x2.shape[2]
    blocks = -(-co // LANES)
    if weight.shape[0] != blocks or weight.shape[3] != c1 + c2 or bias.shape != (blocks * LANES,):
        raise ValueError(
            f"convolution of {c1} + {c2} to {co} channels: weight is {weight.shape}, bias"
            f" {bias.shape}"
        )
    if local_memory:
        program, size, local = local_program(dev, height, width, c1, c2, co)
    else:
        program, size, local = _program(dev, weight.shape[1], height, width, co)
    program.launch(
        "conv_forward",
        size,
        local=local,
        height=height,
        width=width,
        c1=c1,
        c2=c2,
        co=co,
        relu=relu,
        x=x,
        x2=x if x2 is None else x2,
        weight=weight,
        bias=bias,
        out=out,
        tile_count=checked_tiles(dev, tiles, height, width).count,
    )


def conv_backward_input(dev, x, flipped, grad_out, grad_x, masked, tiles=None, local_memory=False):
    """grad_x = gradient of the convolution's input; where masked, of the input of the ReLU that
    made x (zero where x <= 0).

    x, grad_x: (H, W, C), grad_out: (H, W, CO); flipped: (ceil(C/16), K, K, CO, 16) from
    conv_weights.flip_weights. x is read only where masked. tiles: tiles.Tiles of grad_x that are
    written, None = all; local_memory: as in conv_forward. Raises ValueError when shapes do not fit
    together.
    """
    height, width, c = grad_x.shape
    if flipped.shape[0] != -(-c // LANES):
        raise ValueError(f"input gradient of {c} channels: flipped weights are {flipped.shape}")
    if local_memory:
        program, size, local = local_program(dev, height, width, grad_out.shape[2], c)
    else:
        program, size, local = _program(dev, flipped.shape[1], height, width, c)
    program.launch(
        "conv_backward_input",
        size,
        local=local,
        height=height,
        width=width,
        c=c,
        co=grad_out.shape[2],
        masked=masked,
        x=x,
        flipped=flipped,
        grad_out=grad_out,
        grad_x=grad_x,
        tile_count=checked_tiles(dev, tiles, height, width).count,
    )


def _program(dev, k, height, width, channels_out):
    tile, blocks, local = tiling(dev, width, channels_out)
    size = (-(-width // tile), height, -(-channels_out // (LANES * blocks)))
    return dev.program("layers/conv", K=k, TILE=tile, BLOCKS=blocks), size, local
