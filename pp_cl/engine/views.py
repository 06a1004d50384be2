"""Views: images with their cameras, listed by a scene, loaded, and reduced."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError

# Alpha (0 to 255) above which a pixel belongs to the object. Low, since a mask that is too large
# costs points but one that is too small carves the object away, translucent parts first; not 0,
# because the reconstruction filter of NeRF-synthetic leaves alphas of 1 and 2 as far as 3 pixels
# from the object, and masks that once were JPEG carry noise of that size around their edge (NeRD's
# captures). Above 8, both kinds of masks end within 1.5 pixels of alpha 0.5.
MASK_THRESHOLD = 8
# least sides of a reduced image: SSIM's window of 11 and the U-Net's two poolings need room
MIN_SIDE = 16
LEAST_SHARE = 0.75  # of the size that a preset is made for; smaller images would lose details
Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class View:
    """An image that is used at reduced size: its pixels are the means of blocks of downscale x
    downscale stored pixels.

    name: path of the image relative to the scene's folder. stored_camera: the camera of the stored
    image. image: (H, W, 4) uint8, the stored image as straight RGBA (alpha 255 everywhere if the
    file has none); not to be changed. depth_range: (near, far) of this camera, Euclidean distances
    in world units, if the dataset states one. digest: of the file's pixels, see scene/identity.py;
    None for an image that the program made itself. shrunk: how many times the stored image was
    reduced while it was read from its file. unshrunk_camera: camera of the file's image,
    if it differs. is_masked: the image has a mask, even if the object fills it. ignored: (H, W)
    bool, True for pixels that neither the hull nor the loss uses; the image is 0 there. None: no
    such pixels.
    """

    name: str
    stored_camera: Camera
    image: np.ndarray
    depth_range: tuple[float, float] | None = None
    downscale: int = 1
    digest: str | None = None
    shrunk: float = 1
    unshrunk_camera: Camera | None = None
    is_masked: bool = False
    ignored: np.ndarray | None = None

    @property
    def file_camera(self) -> Camera:
        """The camera of the image in its file."""
        return self.unshrunk_camera or self.stored_camera

    @property
    def file_downscale(self) -> float:
        """How many times the image in its file is reduced in total."""
        return self.shrunk * self.downscale

    @cached_property
    def camera(self) -> Camera:
        """The camera of the reduced image."""
        return self.stored_camera.downscaled(self.downscale)

    @cached_property
    def has_mask(self) -> bool:
        """Whether any pixel that is not ignored is less than fully opaque."""
        return bool((self.hull_alpha < 255).any())

    @property
    def hull_alpha(self) -> np.ndarray:
        """(H, W) uint8: the alpha of the stored image, 255 for ignored pixels."""
        alpha = self.image[..., 3]
        return alpha if self.ignored is None else np.where(self.ignored, np.uint8(255), alpha)

    def ignored_crop(
        self, box: tuple[int, int, int, int], jitter: tuple[float, float] = (0, 0)
    ) -> np.ndarray | None:
        """(height, width) bool: True for pixels of Target.crop(box, jitter) whose block contains an
        ignored pixel; None if none does.
        """
        if self.ignored is None:
            return None
        (x0, y0, width, height), k = box, self.downscale
        left, top = (k * c + round(d) for c, d in zip((x0, y0), jitter, strict=True))
        there = self.ignored[max(top, 0) : top + height * k, max(left, 0) : left + width * k]
        before = max(-top, 0), max(-left, 0)
        after = np.subtract((height * k, width * k), np.add(before, there.shape))
        blocks = np.pad(there, list(zip(before, after, strict=True)))
        ignored = np.logical_or.reduce(blocks.reshape(height, k, width, k), (1, 3))
        return ignored if ignored.any() else None

    def ignoring(self, truth: np.ndarray, image: np.ndarray) -> np.ndarray:
        """(height, width, 3): the truth for an image of this view, with the image's own values at
        ignored pixels.
        """
        ignored = self.ignored_crop((0, 0, *truth.shape[1::-1]))
        return truth if ignored is None else np.where(ignored[..., None], image, truth)

    def moved(self, by: ArrayLike) -> "View":
        """The same image, its camera moved by (3,) world units."""
        unshrunk = self.unshrunk_camera and self.unshrunk_camera.moved(by)
        return replace(self, stored_camera=self.stored_camera.moved(by), unshrunk_camera=unshrunk)

    def reduced(self, downscale: int) -> "View":
        """The same image reduced `downscale` times from its stored resolution.

        Raises UserError unless downscale is a whole number that leaves at least MIN_SIDE pixels
        each way.
        """
        asked = downscale * self.shrunk if isinstance(downscale, int) else math.nan
        check_downscale(self.name, self.file_camera, asked)
        return replace(self, downscale=downscale)

    def near_size(self, side: int) -> "View":
        """The same image reduced to about `side` pixels by fitting_downscale()."""
        size = self.stored_camera.width, self.stored_camera.height
        return replace(self, downscale=fitting_downscale(size, side))

    def of_size(self, side: int) -> "View":
        """The image with a longer side of `side` pixels, at most as many as the reduced image has,
        as resampled() makes it.
        """
        scale = side / max(self.camera.width, self.camera.height)
        size = (max(1, round(scale * n)) for n in (self.camera.width, self.camera.height))
        return self.resampled(*size)

    def resampled(self, width: int, height: int) -> "View":
        """The image of width x height pixels, at most as many as the reduced image has; each is the
        mean by area of stored pixels, and ignored if it covers an ignored one.
        """
        from skimage.transform import resize_local_mean

        camera, k = self.camera, self.downscale

        def resized(stored):
            used = stored[: k * camera.height, : k * camera.width].astype(np.float32)
            if used.ndim == 3:
                used[..., :3] *= used[..., 3:]
            return resize_local_mean(used, (height, width, *used.shape[2:]), preserve_range=True)

        image = resized(self.image)
        image[..., :3] /= np.maximum(image[..., 3:], 1 / 255)
        ignored = None if self.ignored is None else resized(self.ignored) > 0
        return replace(
            self,
            stored_camera=camera.stretched(width, height),
            image=np.rint(image).astype(np.uint8),
            downscale=1,
            shrunk=self.file_downscale * camera.width / width,
            unshrunk_camera=self.file_camera,
            ignored=ignored,
        )

    def crop_camera(
        self, box: tuple[int, int, int, int], jitter: tuple[float, float] = (0, 0)
    ) -> Camera:
        """The camera of Target.crop(box, jitter) of this view."""
        dx, dy = (stored / self.downscale for stored in jitter)
        return self.camera.shifted(dx, dy).crop(*box)

    def crop_size(self, side: int) -> tuple[int, int]:
        """(width, height) of a crop of at most `side` x `side` pixels; 0: the whole image."""
        size = self.camera.width, self.camera.height
        return (min(side, size[0]), min(side, size[1])) if side else size

    def object_bounds(self, margin: int) -> tuple[int, int, int, int]:
        """(x0, y0, x1, y1): the half-open box of the reduced image's pixels that show the object,
        with `margin` pixels more on every side, cut off at the image's border.

        The whole image if its mask is empty.
        """
        camera, k = self.camera, self.downscale
        mask = self.image[: camera.height * k, : camera.width * k, 3] > MASK_THRESHOLD
        x0, x1 = _extent(mask.any(axis=0), k, margin)
        y0, y1 = _extent(mask.any(axis=1), k, margin)
        return x0, y0, x1, y1


def check_downscale(name: str, camera: Camera, downscale: float) -> None:
    """Raise UserError unless the image `name` of a camera can be reduced `downscale` times: a
    number that leaves at least MIN_SIDE pixels each way.
    """
    width, height = camera.width, camera.height
    most = min(width, height) // MIN_SIDE
    if most == 0:
        raise UserError(
            f"{name}: {width}x{height} pixels; at least {MIN_SIDE}x{MIN_SIDE} are needed"
        )
    if not 1 <= downscale <= most:
        raise UserError(
            f"--downscale {downscale:g}: not a number from 1 to {most}, the range for the"
            f" {width}x{height} pixels of {name}"
        )


def fitting_downscale(size: tuple[int, int], side: int | None) -> int:
    """The whole number that reduces images of `size`, (width, height) pixels, so that their longer
    side comes nearest to `side`, not below three quarters of it; 1 where side is None.
    """
    if side is None:
        return 1
    longer, most = max(size), min(size) // MIN_SIDE
    fitting = [k for k in range(1, most + 1) if longer / k >= LEAST_SHARE * side]
    return min(fitting, key=lambda k: abs(longer / k - side), default=1)


def _extent(occupied, downscale, margin):
    """(first, last + 1) reduced pixel of the occupied stored columns or rows (N,) bool, grown by
    the margin; the whole length if none is occupied.
    """
    size, pixels = len(occupied) // downscale, np.flatnonzero(occupied) // downscale
    if pixels.size == 0:
        return 0, size
    return max(int(pixels[0]) - margin, 0), min(int(pixels[-1]) + 1 + margin, size)


def border(image: np.ndarray) -> np.ndarray:
    """(N, ...) the pixels of the outermost rows and columns of an image (H, W, ...)."""
    return np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])


def evenly(items: Sequence[Item], most: int | None) -> list[Item]:
    """At most `most` of the items, spread evenly and including the first; None: all items."""
    n = len(items)
    return list(items) if most is None or n <= most else [items[n * i // most] for i in range(most)]
