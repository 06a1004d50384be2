"""Replaces the U-Net where features are already colours, as in 3D Gaussian splatting: the image is
the first three of them.
"""

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.simple import first_features_backward, first_features_forward


class FirstFeatures:
    """Has the methods of UNet, but no parameters."""

    multiple = 1  # image sides must be multiples of this

    def __init__(self, dev: Device):
        self.dev = dev
        self.parameters: dict[str, Array] = {}
        self.all_parameters = dev.zeros((1,))
        self._shape: tuple[int, ...] = ()  # shape of the features in the last forward()

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
    def gradient_tiles(*_: object) -> None:
        """None: there is no background to leave out."""

    def forward(self, x: Array, training: bool = True, plan: None = None) -> Array:
        """(H, W, 3) float32 image of the features x (H, W, C)."""
        self._shape = x.shape
        image = self.dev.empty((*x.shape[:2], 3))
        first_features_forward(self.dev, x, image)
        return image

    def backward(self, grad_image: Array) -> tuple[Array, None]:
        """((H, W, C) float32 gradient of the features of the last forward(), None)."""
        grad_features = self.dev.empty(self._shape)
        first_features_backward(self.dev, grad_image, grad_features)
        return grad_features, None
