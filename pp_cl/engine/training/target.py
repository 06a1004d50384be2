"""The training target on the device: an image reduced by area on premultiplied colour, over
white.
"""

from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.views import View

AROUND = 2  # pixels that interpolation reads on either side


def target_table(size: tuple[int, int]) -> Table:
    """The buffers of Target for a crop of size (height, width), without the rows of the image."""
    return {"target": ((*size, 3), np.float32), "alpha": (size, np.float32)}


class Target:
    """Makes targets from views.

    A target pixel is the mean of the stored pixels of its block. Of a block that reaches outside
    the image, only pixels inside count; a block wholly outside is white.
    """

    def __init__(self, dev: Device):
        self.dev = dev
        self._buffers = Buffers(dev)

    def crop(
        self, view: View, box: tuple[int, int, int, int], jitter: tuple[float, float] = (0, 0)
    ) -> tuple[Array, Array]:
        """(colour (height, width, 3), alpha (height, width)), float32: a part of a view's reduced
        image, and the mean alpha of its pixels, 0 outside of the image; valid until the next call.

        box: (x0, y0, width, height), reduced pixels; may reach outside of the image. jitter: stored
        pixels by which all blocks lie further right and down: whole numbers, or at most half a
        pixel of a view that is not reduced, which is then interpolated. View.crop_camera gives the
        camera.
        """
        x0, y0, width, height = box
        self._buffers.require(target_table((height, width)))
        whole = [round(stored) for stored in jitter]
        left, top = (view.downscale * c + d for c, d in zip((x0, y0), whole, strict=True))
        stored_height, stored_width, _ = view.image.shape
        # only rows that the crop reads go to the device, at least one
        first = min(max(top - AROUND, 0), stored_height - 1)
        last = top + view.downscale * height + AROUND
        rows = view.image[first : max(last, first + 1)]
        most = min(view.downscale * height + 2 * AROUND, stored_height) * stored_width * 4
        image = self.dev.scratch("stored image", most, np.uint8)[: rows.size].reshape(rows.shape)
        self.dev.send(image, rows)
        across, down = (stored - d for stored, d in zip(jitter, whole, strict=True))
        file, kernel = "training/target", "target_forward"
        own: dict[str, Any] = {"downscale": view.downscale}
        if across or down:
            file, kernel = "training/target_between", "target_between"
            own = {"across": across, "down": down}
        self.dev.program(file).launch(
            kernel,
            (width, height),
            width=width,
            height=height,
            **own,
            left=left,
            top=top - first,
            image_width=stored_width,
            image_height=len(rows),
            image=image,
            target=self._buffers.target,
            alpha=self._buffers.alpha,
        )
        return self._buffers.target, self._buffers.alpha

    def whole(self, view: View) -> np.ndarray:
        """(height, width, 3) float32, on the host: a view's whole reduced image."""
        return self.crop(view, (0, 0, view.camera.width, view.camera.height))[0].get()
