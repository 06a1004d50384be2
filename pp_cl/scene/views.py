"""A photograph with its camera and mask, at full resolution and reduced."""

from dataclasses import dataclass

import numpy as np

from pp_cl.errors import UserError
from pp_cl.scene.camera import Camera

# Alpha (0 to 255) above which a pixel belongs to the object. Low, since a mask that is too large
# costs points but one that is too small carves the object away, translucent parts first; not 0,
# because the reconstruction filter of NeRF-synthetic leaves alphas of 1 and 2 as far as 3 pixels
# from the object, and masks that once were JPEG carry noise of that size around their edge (NeRD's
# captures). Above 8 both end within 1.5 pixels of alpha 0.5.
MASK_THRESHOLD = 8


# pixels of a reduced image: SSIM's window of 11 and the U-Net's two poolings need room
MIN_SIDE = 16


@dataclass(frozen=True, eq=False)
class View:
    """One photograph.

    name: path of the image relative to the scene's folder. camera: of the full stored resolution;
    near and far are NaN while unknown. image: (H, W, 4) uint8, straight RGBA (alpha 255 everywhere
    if the file has none); not to be changed.
    """

    name: str
    camera: Camera
    image: np.ndarray

    @property
    def has_depth_range(self):
        """True if near and far are known."""
        return bool(np.isfinite(self.camera.near) and np.isfinite(self.camera.far))


def reduced_camera(view, downscale):
    """Camera of a view reduced `downscale` times.

    Raises UserError unless that is a whole number that leaves at least MIN_SIDE pixels each way.
    """
    camera = view.camera
    most = min(camera.width, camera.height) // MIN_SIDE
    if most == 0:
        raise UserError(
            f"{view.name}: {camera.width}x{camera.height} pixels; at least {MIN_SIDE}x{MIN_SIDE}"
            " are needed"
        )
    if not isinstance(downscale, int) or not 1 <= downscale <= most:
        raise UserError(
            f"--downscale {downscale}: not a whole number from 1 to {most}, the range for the "
            f"{camera.width}x{camera.height} pixels of {view.name}"
        )
    return camera.downscaled(downscale)


def object_box(views, downscale, margin):
    """[(x0, y0, x1, y1)] for each view: the pixels of the reduced image, half-open, that show the
    object.

    margin: reduced pixels added on every side, as far as the image goes. A view without object gets
    its whole image.
    """
    return [_object_box(view, downscale, margin) for view in views]


def _object_box(view, downscale, margin):
    camera = reduced_camera(view, downscale)
    mask = view.image[: camera.height * downscale, : camera.width * downscale, 3] > MASK_THRESHOLD
    x0, x1 = _extent(mask.any(axis=0), downscale, margin)
    y0, y1 = _extent(mask.any(axis=1), downscale, margin)
    return x0, y0, x1, y1


def _extent(occupied, downscale, margin):
    """(first, last + 1) reduced pixel of the occupied stored columns or rows; the whole length if
    there are none.
    """
    size, found = len(occupied) // downscale, np.flatnonzero(occupied) // downscale
    if found.size == 0:
        return 0, size
    return max(int(found[0]) - margin, 0), min(int(found[-1]) + 1 + margin, size)
