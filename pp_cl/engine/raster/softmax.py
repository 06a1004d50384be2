"""Launches the paper's softmax, the alternative to alpha compositing."""

from typing import Any

from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes


def softmax_weights(
    dev: Device, pixels: int, gamma: float, derivatives: bool, **arguments: Any
) -> None:
    """Compute the blend weights of Eq. (1). gamma: depth sharpness. derivatives: also write
    pixel_derivative. arguments: the kernel's.
    """
    macros = {"DROPS": int(arguments["early_stop"] > 0), "DERIVATIVES": int(derivatives)}
    dev.program("raster/softmax", LANES=lanes(dev), **macros).launch(
        "softmax_weights", pixels, sharpness=1 / gamma, **arguments
    )


def softmax_gradient(dev: Device, pixels: int, **arguments: Any) -> None:
    """Write pair_gradient and pixel_blend for blend_backward() of blend.py. arguments: the
    kernel's.
    """
    dev.program("raster/softmax_gradient").launch("softmax_gradient", pixels, **arguments)
