"""The gate of a gated convolution on (H, W, C) float32 feature maps: ELU of features times the
sigmoid of gates.

x: (H, W, 2 C), the features of each pixel and then its gates. tiles: those of the result to
compute, None = all.
"""

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import channel_ranges, lanes
from pp_cl.layers.tiles import Tiles, checked_tiles


def gate_forward(dev: Device, x: Array, out: Array, *, tiles: Tiles | None = None) -> None:
    """out (H, W, C) = ELU(features) * sigmoid(gates). Raises ValueError for other shapes."""
    _launch(dev, "gate_forward", out.shape, tiles, x=x, out=out)


def gate_backward(
    dev: Device, x: Array, grad_out: Array, grad_x: Array, *, tiles: Tiles | None = None
) -> None:
    """grad_x (H, W, 2 C) = gradient of gate_forward, given grad_out (H, W, C). Raises ValueError
    for other shapes.
    """
    _launch(dev, "gate_backward", grad_out.shape, tiles, x=x, grad_out=grad_out, grad_x=grad_x)


def _launch(dev, kernel, shape, tiles, **arguments):
    """shape: of the output."""
    h, w, c = shape
    if arguments["x"].shape != (h, w, 2 * c):
        raise ValueError(f"a gate from {arguments['x'].shape} to {shape}: expected {(h, w, 2 * c)}")
    size, work_group = channel_ranges(dev, h, w, c)
    dev.program("layers/gate", LANES=lanes(dev)).launch(
        kernel,
        size,
        work_group,
        h=h,
        w=w,
        c=c,
        tile_count=checked_tiles(dev, tiles, h, w).count,
        **arguments,
    )
