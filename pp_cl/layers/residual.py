"""The connection that takes the first three features past the network, into the image."""

from pyopencl.array import Array

from pp_cl.device.device import Device


def residual_forward(dev: Device, features: Array, image: Array, share: float) -> None:
    """image (H, W, 3) += share * (the first three of the features (H, W, C) - the background's 1).

    Raises ValueError for other shapes.
    """
    sizes = _sizes(features, image)
    _launch(dev, "residual_forward", sizes, share=share, features=features, image=image)


def residual_backward(dev: Device, grad_image: Array, grad_features: Array, share: float) -> None:
    """Adds the gradient of residual_forward to grad_features (H, W, C), of grad_image (H, W, 3)."""
    sizes = _sizes(grad_features, grad_image)
    arrays = {"grad_image": grad_image, "grad_features": grad_features}
    _launch(dev, "residual_backward", sizes, share=share, **arrays)


def _sizes(features, image):
    height, width, channels = features.shape
    if channels < 3 or image.shape != (height, width, 3):
        raise ValueError(f"an image {image.shape} is none of features {features.shape}")
    return {"n": height * width, "channels": channels}


def _launch(dev, kernel, sizes, **arguments):
    dev.program("layers/residual").launch(kernel, sizes["n"], **sizes, **arguments)
