"""The network's last step: scales the output of its last layer to the image, and with a residual
connection adds the first three blended features.
"""

from pyopencl.array import Array

from pp_cl.device.device import Device

SHARE = 0.25  # of a feature in its colour; features differ by about four times as much


def output_forward(dev: Device, image: Array, features: Array | None) -> None:
    """image (H, W, 3) = 0.5 + 0.5 * image, and SHARE * (the first three of the features (H, W, C)
    - the background's 1), if they are given. Raises ValueError for other shapes.
    """
    height, width, channels = _checked(image if features is None else features, image)
    dev.program("layers/output").launch(
        "output_forward",
        height * width,
        n=height * width,
        channels=channels,
        residual=features is not None,
        share=SHARE,
        features=image if features is None else features,
        image=image,
    )


def output_backward(dev: Device, grad_image: Array, grad_out: Array) -> None:
    """Write grad_out (H, W, 3), dL/d(last layer's output), from grad_image (H, W, 3)."""
    _checked(grad_out, grad_image)
    n = grad_image.size
    dev.program("layers/output").launch(
        "output_backward", n, n=n, grad_image=grad_image, grad_out=grad_out
    )


def residual_backward(dev: Device, grad_image: Array, grad_features: Array) -> None:
    """Add the gradient through the residual connection, of grad_image (H, W, 3), to grad_features
    (H, W, C).
    """
    height, width, channels = _checked(grad_features, grad_image)
    dev.program("layers/output").launch(
        "residual_backward",
        height * width,
        n=height * width,
        channels=channels,
        share=SHARE,
        grad_image=grad_image,
        grad_features=grad_features,
    )


def _checked(features, image):
    height, width, channels = features.shape
    if channels < 3 or image.shape != (height, width, 3):
        raise ValueError(f"an image {image.shape} is none of features {features.shape}")
    return features.shape
