"""The launches of the paper's softmax, in place of alpha compositing."""

from typing import Any

from pp_cl.engine.device.device import Device


def softmax_weights(
    dev: Device, pixels: int, gamma: float, defines: dict[str, Any], **arguments: Any
) -> None:
    """The blend weights of Eq. (1). gamma: depth sharpness. defines, arguments: as of alpha_weights
    in weights.py, and the camera.
    """
    drops = int(arguments["early_stop"] > 0)
    dev.program("raster/softmax", DROPS=drops, **defines).launch(
        "softmax_weights", pixels, sharpness=1 / gamma, **arguments
    )


def softmax_gradient(dev: Device, pixels: int, **arguments: Any) -> None:
    """What the backward pass of blend.py needs of each fragment and pixel. arguments: of the
    kernel.
    """
    dev.program("raster/softmax_gradient").launch("softmax_gradient", pixels, **arguments)
