"""Recognises a uniform background at an image's border, and makes a mask from its colour.

Light that falls off and a lens that darkens its corners change a uniform background smoothly, which
a quadratic function of the place describes, fitted to the border. The border's noise decides how
far from it a colour may be.
"""

import numpy as np
from skimage.color import rgb2lab

from pp_cl import Config
from pp_cl.errors import UserError
from pp_cl.scene import cut_out
from pp_studio.capture.packages import needed

cv2 = needed("cv2")

SIDE = 1600  # longer side, pixels, of the image in which the background is recognised
SHARE = 0.9  # share of a border that must show the background alone
PLAIN = 4.0  # CIELAB distance: smoothed noise has less, texture with features more
GRAIN = 3  # pixels over which noise is smoothed
NOISY = 10.0  # median distances of the border beyond which a colour is not the background's
SPECK = 5e-5  # of the image; smaller regions of a mask are dropped
FITTED = 4  # fits, each to the part of the border near the fit before


def is_uniform(image: np.ndarray) -> bool:
    """Whether the border of an image (H, W, 3) uint8 shows one colour, apart from noise."""
    smooth = cv2.blur(image, (GRAIN, GRAIN))
    return bool((_levelled(smooth)[1] < PLAIN).mean() >= SHARE)


def uniform_mask(image: np.ndarray, name: str, with_holes: bool = False) -> np.ndarray | None:
    """(H, W) uint8 mask of a photograph (H, W, 3 or 4), None if its border shows more than one
    colour. with_holes: as in cut_out().
    """
    height, width = image.shape[:2]
    scale = min(1, SIDE / max(height, width))
    size = max(1, round(scale * width)), max(1, round(scale * height))
    small = image if scale == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    level, away = _levelled(small[..., :3])
    tolerance = float(np.clip(NOISY * np.median(away), PLAIN, Config().scene.mask_tolerance))
    try:
        mask = cut_out(level, name, tolerance, with_holes)[..., 3]
    except UserError:
        return None
    if (mask[_border(mask)] < 128).mean() < SHARE:
        return None
    # removes single pixels that compression leaves near edges
    _, regions, facts, _ = cv2.connectedComponentsWithStats((mask > 0).astype(np.uint8))
    mask[(facts[:, cv2.CC_STAT_AREA] < SPECK * mask.size)[regions]] = 0
    return cv2.resize(mask, (width, height))


def _levelled(image):
    """((H, W, 3) uint8: an image without the smooth changes of its background, (N,) CIELAB
    distances of its border from one colour after that).
    """
    height, width = image.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).astype(np.float32)
    places, colours = terms[_border(image)], image[_border(image)].astype(np.float32)
    middle = np.median(colours, axis=0)
    away = _distances(colours, middle[None])
    for _ in range(FITTED):
        near = away <= max(PLAIN, np.median(away))
        factors = np.linalg.lstsq(places[near], colours[near], rcond=None)[0]
        away = _distances(colours, places @ factors)
    level = np.clip(image + (middle - terms @ factors), 0, 255)
    return (level + 0.5).astype(np.uint8), away


def _border(image):
    """(H, W) bool: the outermost rows and columns."""
    marked = np.ones(image.shape[:2], bool)
    marked[1:-1, 1:-1] = False
    return marked


def _distances(colours, other):
    """CIELAB distances between colours from 0 to 255."""
    a, b = (rgb2lab(np.clip(rgb, 0, 255) / 255) for rgb in (colours, other))
    return np.linalg.norm(a - b, axis=-1)
