"""What stands in place of the U-Net where features are colours already, as in 3D Gaussian
splatting: the image is the first three of them.
"""

from collections.abc import Callable

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.simple import mean_backward, mean_forward


class Means:
    """Has what a model's network has, see UNet, but no parameters. A pixel of the image is the mean
    of scale x scale pixels of the features; scale may change between two images.
    """

    multiple = 1  # of which the sides of images are

    def __init__(self, dev: Device, scale: int = 1):
        self.dev, self.scale = dev, scale
        self.parameters: dict[str, Array] = {}
        self.all_parameters, self.all_gradients = dev.zeros((1,)), dev.zeros((1,))
        self._shape: tuple[int, ...] = ()  # of the features of the last forward()

    def split(self, whole: Array) -> dict[str, Array]:
        """Nothing: there are no parameters."""
        return {}

    def release(self) -> None:
        """Do nothing: no arrays are held."""

    def freeze(self) -> None:
        """Do nothing: there are no parameters."""

    @staticmethod
    def is_planned(size: tuple[int, int]) -> bool:
        """False: no tiles are left out."""
        return False

    @staticmethod
    def plan_tiles(*_: object) -> None:
        """None: there is no background to leave out."""

    @staticmethod
    def gradient_tiles(*_: object) -> Callable[[], None]:
        """What gives None: there is no background to leave out."""
        return lambda: None

    def forward(self, x: Array, training: bool = True, plan: None = None) -> Array:
        """(H, W, 3) float32 image of the features x (scale H, scale W, C)."""
        height, width, _ = self._shape = x.shape
        image = self.dev.empty((height // self.scale, width // self.scale, 3))
        mean_forward(self.dev, x, image, self.scale)
        return image

    def backward(self, grad_image: Array) -> Array:
        """(scale H, scale W, C) float32 gradient of the features of the last forward()."""
        grad_features = self.dev.empty(self._shape)
        mean_backward(self.dev, grad_image, grad_features, self.scale)
        return grad_features
