"""Images that a scene lists; reads the pixels and the mask of one, and removes its distortion."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.views import MASK_THRESHOLD, View
from pp_cl.errors import Unusable
from pp_cl.files.image import read_rgba
from pp_cl.scene.lens import LensDistortion, undistort
from pp_cl.scene.masks import OPAQUE, cut_out, is_by_colour, read_mask_of_size
from pp_cl.settings import SceneConfig

# Images that take more memory than this, as RGBA, are reduced while they are read. The number is
# fixed and does not depend on free memory, so that a command gives the same bits on every machine.
MOST_IMAGE_BYTES = 2**29
STRAIGHT = LensDistortion()  # a lens without distortion
DIGITS = 16  # hexadecimal digits of a view's digest: they show changed pixels, not forged ones


@dataclass(frozen=True)
class ImageFile:
    """An image that a scene lists, before its pixels are read. name, mask: paths relative to the
    scene's folder; mask None: the image's own alpha. camera: camera of the image without
    distortion. depth_range: (near, far), Euclidean distances in world units, if stated. lens: the
    distortion of the stored image. ignore: path of an image that is white (ignores_black: black)
    on pixels to ignore. turned: apply the EXIF orientation although the size fits without it.
    """

    name: str
    camera: Camera
    depth_range: tuple[float, float] | None = None
    mask: str | None = None
    lens: LensDistortion = field(default_factory=LensDistortion)
    ignore: str | None = None
    ignores_black: bool = False
    turned: bool = False


def shrink_factor(sizes: Sequence[tuple[int, int]], downscale: int) -> int:
    """The factor by which to reduce images of these (width, height) while they are read: the least
    divisor of `downscale` with which they fit in MOST_IMAGE_BYTES, or `downscale` if none does.
    """
    divisors = (f for f in range(1, downscale + 1) if downscale % f == 0)
    return next((f for f in divisors if image_bytes(sizes, f) <= MOST_IMAGE_BYTES), downscale)


def image_bytes(sizes: Sequence[tuple[int, int]], factor: int) -> int:
    """Bytes of images of these (width, height), reduced `factor` times."""
    return sum(4 * (width // factor) * (height // factor) for width, height in sizes)


def shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """(H // factor, W // factor, 4) uint8 straight RGBA of (H, W, 4): rounded means of the
    premultiplied colours of factor x factor pixels.
    """
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    small, area = np.empty((height, width, 4), np.uint8), factor**2
    columns = np.arange(0, factor * width, factor)
    for row in range(height):
        block = image[factor * row : factor * (row + 1), : factor * width].astype(np.uint16)
        alpha = block[..., 3:]
        block[..., :3] *= alpha
        sums = np.add.reduceat(block.sum(0, dtype=np.uint32), columns, axis=0)
        opacity = sums[:, 3:]
        small[row, :, :3] = (sums[:, :3] + opacity // 2) // np.maximum(opacity, 1)
        small[row, :, 3:] = (opacity + area // 2) // area
    return small


def read_view(
    folder: Path, image_file: ImageFile, masks: SceneConfig, dev: Device | None, factor: int = 1
) -> View:
    """The View of an image of the scene in a folder, with its mask, reduced `factor` times. dev:
    the device that removes distortion. Raises Unusable if the image or a mask cannot be used.
    """
    camera = image_file.camera

    def used(image):
        if image_file.lens:
            return undistort(dev, image, camera, image_file.lens, factor)
        return shrink(image, factor)

    size, ignored = (camera.width, camera.height), None
    if image_file.ignore:
        mask = read_mask_of_size(folder / image_file.ignore, size) > OPAQUE // 2
        mask = np.where(mask != image_file.ignores_black, np.uint8(OPAQUE), np.uint8(0))
        ignored = used(np.dstack([mask] * 4))[..., 3] > MASK_THRESHOLD
    image = read_rgba(folder / image_file.name, size, turned=image_file.turned)
    if image_file.mask:
        image[..., 3] = read_mask_of_size(folder / image_file.mask, image.shape[1::-1])
    elif masks.mask_from in ("box", "none"):
        image[..., 3] = OPAQUE
    digest = pixel_digest(image, image_file.lens, ignored)
    image = used(image)
    if is_by_colour(masks):
        image = cut_out(image, image_file.name, masks.mask_tolerance)
    if ignored is not None:
        image = np.where(ignored[..., None], np.uint8(0), image)
    if image[..., 3].max() <= MASK_THRESHOLD:
        text = f"{folder / image_file.name}: its mask is empty; correct it, or remove the image"
        raise Unusable(text, "an empty mask")
    return View(
        image_file.name,
        camera.downscaled(factor) if factor > 1 else camera,
        image,
        image_file.depth_range,
        digest=digest,
        shrunk=factor,
        unshrunk_camera=camera if factor > 1 else None,
        is_masked=image_file.mask is not None,
        ignored=ignored,
    )


def pixel_digest(
    image: np.ndarray, lens: LensDistortion = STRAIGHT, ignored: np.ndarray | None = None
) -> str:
    """Hex digest of a uint8 image with its mask, its distortion and its ignored pixels."""
    digest = hashlib.sha256(np.ascontiguousarray(image).data)
    digest.update(repr(lens).encode() if lens else b"")
    digest.update(b"" if ignored is None else np.packbits(ignored).data)
    return digest.hexdigest()[:DIGITS]
