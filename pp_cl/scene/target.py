"""The training target on the device: a photograph reduced by area on premultiplied colour, over
white.
"""

from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers
from pp_cl.device.device import Device
from pp_cl.scene.views import View


class Target:
    """Makes targets from the view that was loaded last.

    A target pixel is the mean of the stored pixels of its block; where a block reaches outside of
    the image only those inside count, and wholly outside the target is white.
    """

    def __init__(self, dev: Device):
        self.dev = dev
        self.program = dev.program("scene/target")
        self._view: Any = None  # the View loaded, and its image on the device
        self._image: Any = None
        self._buffers = Buffers(dev)

    def load(self, view: View) -> None:
        """Bring a view's image to the device, unless it is there."""
        if self._view is None or self._view.image is not view.image:
            if self._image is None or self._image.shape != view.image.shape:
                self._image = self.dev.empty(view.image.shape, np.uint8)
            self.dev.send(self._image, view.image)
        self._view = view

    def crop(self, box: tuple[int, int, int, int], jitter: tuple[int, int] = (0, 0)) -> Array:
        """(height, width, 3) float32: a part of the loaded view's reduced image, valid until the
        next call.

        box: (x0, y0, width, height), reduced pixels; may reach outside of the image. jitter: stored
        pixels by which all blocks lie further right and down. View.crop_camera gives the camera.
        """
        self._buffers.require({"target": ((box[3], box[2], 3), np.float32)})
        self._launch("target_forward", box, jitter, target=self._buffers.target)
        return self._buffers.target

    def alpha(self, box: tuple[int, int, int, int], jitter: tuple[int, int] = (0, 0)) -> Array:
        """(height, width) float32: the mean alpha of the same pixels, 0 outside of the image; valid
        until the next call.
        """
        self._buffers.require({"alpha": ((box[3], box[2]), np.float32)})
        self._launch("target_alpha", box, jitter, alpha=self._buffers.alpha)
        return self._buffers.alpha

    def _launch(self, kernel, box, jitter, **output):
        x0, y0, width, height = box
        downscale = self._view.downscale
        self.program.launch(
            kernel,
            (width, height),
            width=width,
            height=height,
            downscale=downscale,
            left=downscale * x0 + jitter[0],
            top=downscale * y0 + jitter[1],
            image_width=self._image.shape[1],
            image_height=self._image.shape[0],
            image=self._image,
            **output,
        )

    def whole(self) -> np.ndarray:
        """(height, width, 3) float32, on the host: the loaded view's whole reduced image."""
        camera = self._view.camera
        return self.crop((0, 0, camera.width, camera.height)).get()
