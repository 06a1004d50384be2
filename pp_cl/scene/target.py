"""What a rendering is compared with: views on the device, reduced by area on premultiplied colour,
over white.
"""

import numpy as np

from pp_cl.scene.views import reduced_camera


class Target:
    """Makes targets of one reduction from the view loaded last, and the cameras that see them.

    phase: (ka, kb), stored pixels by which the blocks of the reduction start further right and
    down. A target pixel is the mean of the stored pixels of its block; where a block reaches
    outside of the image only those inside count, and wholly outside the target is white.
    """

    def __init__(self, dev, downscale):
        self.dev = dev
        self.downscale = downscale
        self.program = dev.program("scene/target")
        self._source = self._image = None  # the image loaded, in numpy and on the device

    def load(self, view):
        """Bring a view's image to the device, unless it is there. Raises UserError if the view
        cannot be reduced so far.
        """
        if view.image is self._source:
            return
        reduced_camera(view, self.downscale)
        if self._image is None or self._image.shape != view.image.shape:
            self._image = self.dev.empty(view.image.shape, np.uint8)
        self._image.set(np.ascontiguousarray(view.image))
        self._source = view.image

    def crop(self, x0, y0, width, height, phase=(0, 0)):
        """(height, width, 3) float32 array: columns from x0 and rows from y0 of the loaded view's
        reduced image.
        """
        target = self.dev.empty((height, width, 3))
        k = self.downscale
        self.program.launch(
            "target_forward",
            (width, height),
            width=width,
            height=height,
            k=k,
            left=k * x0 + phase[0],
            top=k * y0 + phase[1],
            image_width=self._image.shape[1],
            image_height=self._image.shape[0],
            image=self._image,
            target=target,
        )
        return target

    def camera(self, view, x0, y0, width, height, phase=(0, 0)):
        """The Camera whose picture crop(x0, y0, width, height, phase) of this view is. Raises
        UserError as load does.
        """
        k = self.downscale
        return (
            reduced_camera(view, k).shifted(phase[0] / k, phase[1] / k).crop(x0, y0, width, height)
        )
