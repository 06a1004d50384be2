"""Images that a scene lists, before their pixels are read, and how far reading reduces them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.scene.distortion import Distortion

# Of a scene's photographs in memory, as RGBA; more than this is reduced while it is read. A fixed
# number, not what happens to be free: the same command gives the same bits on every machine.
KEPT_BYTES = 2**29


@dataclass(frozen=True)
class Photograph:
    """A photograph that a scene lists, before its pixels are read.

    name: path of the image relative to the scene's folder. camera: of the stored image, freed of
    distortion. depth_range: (near, far), Euclidean distances in world units, if the format states
    one. mask: path of its mask relative to the scene's folder, white where the object is; None: the
    image's own alpha. distortion: of the image as it lies in the file. ignore: path of an image
    that is white where this one says nothing; if ignores_black, it is black there.
    """

    name: str
    camera: Camera
    depth_range: tuple[float, float] | None = None
    mask: str | None = None
    distortion: Distortion = field(default_factory=Distortion)
    ignore: str | None = None
    ignores_black: bool = False


def shrink_factor(sizes: Sequence[tuple[int, int]], downscale: int) -> int:
    """How many times to reduce photographs of these (width, height), in pixels, while they are
    read, where a training reduces them `downscale` times: the least divisor of it with which they
    take KEPT_BYTES at most, else all of it.
    """
    divisors = (f for f in range(1, downscale + 1) if downscale % f == 0)
    return next((f for f in divisors if kept_bytes(sizes, f) <= KEPT_BYTES), downscale)


def kept_bytes(sizes: Sequence[tuple[int, int]], factor: int) -> int:
    """Bytes of the images that photographs of these (width, height) become."""
    return sum(4 * (width // factor) * (height // factor) for width, height in sizes)


def shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """(H // factor, W // factor, 4) uint8 straight RGBA of (H, W, 4): means of blocks of
    factor x factor pixels on premultiplied colour, rounded. Rows and columns that fill no block are
    cut off.
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
