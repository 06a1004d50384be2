"""The mask of an image: from a file, from its alpha, from a uniform background, or none."""

import warnings
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image
from scipy.ndimage import distance_transform_edt
from skimage.color import rgb2lab
from skimage.measure import label
from skimage.morphology import dilation, erosion

from pp_cl.engine.views import MASK_THRESHOLD, border
from pp_cl.errors import Unusable, UserError
from pp_cl.files.image import read_mask, same_shape
from pp_cl.scene.lookup import find_mask
from pp_cl.settings import SceneConfig

BORDER_SHARE = 0.5  # share of the border's pixels that must have its median colour
OPAQUE = 255
BAD_MASK = "a mask that cannot be used"
HOLE = 5e-5  # share of the image; a smaller region is no hole
HALF = 16, 239  # alphas between which a pixel is half transparent
EDGE = 2.5  # pixels over which lens and demosaicing mix colours


AS_GIVEN = SceneConfig()  # the masks of the scene's format, or alpha without them


def is_by_colour(masks: SceneConfig) -> bool:
    """Whether cut_out() makes the masks, from the reduced images, since it takes long."""
    return masks.mask_from == "color" and not masks.masks


def named_mask(folder: Path, *names: str) -> Path:
    """The file in a folder with the mask of an image, which may have several names or paths. Raises
    UserError if there is none.
    """
    for name in names:
        if mask := find_mask(folder, name) or find_mask(folder, PurePosixPath(name).name):
            return folder / mask
    usual = PurePosixPath(names[0]).stem
    raise UserError(f"{folder}: no mask for {names[0]}; add {usual}.png, white where the object is")


def read_mask_of_size(file: Path, size: tuple[int, int]) -> np.ndarray:
    """(H, W) uint8 mask in a file, 255 on the object, resized to its image's (width, height).
    Raises Unusable, also if the mask has another aspect ratio.
    """
    try:
        mask = read_mask(file)
    except UserError as error:
        raise Unusable(error, BAD_MASK) from error
    height, width = mask.shape
    if size == (width, height):
        return mask
    if not same_shape((width, height), size):
        raise Unusable(
            f"{file}: {width}x{height} pixels, but its image has {size[0]}x{size[1]}; make it the"
            " image's size",
            BAD_MASK,
        )
    warnings.warn(f"{file.parent}: masks are resized to their images", stacklevel=1)
    return np.array(Image.fromarray(mask).resize(size, Image.Resampling.BILINEAR))


def cut_out(image: np.ndarray, name: str, tolerance: float, with_holes: bool = False) -> np.ndarray:
    """(H, W, 4) uint8: the image without its uniform background, which consists of the pixels that
    are connected to the border and within `tolerance` of its median colour in CIELAB. Regions of
    that colour inside the object stay opaque; with_holes makes all but the smallest transparent.
    Pixels at the edge count as mixtures of the background with the nearest colour of the object.
    Raises Unusable if the border has several colours.
    """
    colour = image[..., :3] / 255.0
    behind = np.median(border(colour), axis=0)
    distance = np.linalg.norm(rgb2lab(colour) - rgb2lab(behind), axis=2)
    share = (border(distance) < 2 * tolerance).mean()
    if share < BORDER_SHARE:
        raise Unusable(
            f"{name}: only {share:.0%} of its border has one colour, so --mask-from color finds no"
            " background; give masks with --masks FOLDER, or a higher scene.mask_tolerance",
            "no uniform background",
        )
    places = distance < tolerance
    regions = label(places, connectivity=1)
    chosen = border(regions)
    if with_holes:
        large = np.flatnonzero(np.bincount(regions.ravel()) > HOLE * regions.size)
        chosen = np.append(chosen, large)
    outside = places & np.isin(regions, np.unique(chosen[chosen > 0]))
    within = distance_transform_edt(~outside) > EDGE
    alpha = np.where(outside, 0, np.clip(distance / tolerance - 1, 0, 1))
    alpha[within] = 1
    if within.any():
        away, nearest = distance_transform_edt(~within, return_indices=True)
        mixed = ~outside & ~within & (away < 2 * EDGE)
        step = colour[tuple(nearest)] - behind  # from the background to the nearest colour within
        length = np.maximum((step**2).sum(-1), 1e-6)
        share = np.clip(((colour - behind) * step).sum(-1) / length, 0, 1)
        alpha[mixed] = share[mixed]
    straight = (colour - (1 - alpha[..., None]) * behind) / np.maximum(alpha, 1 / 255)[..., None]
    rgba = np.dstack([np.clip(straight, 0, 1), alpha])
    return (255 * rgba + 0.5).astype(np.uint8)


def half_transparent(alpha: np.ndarray) -> float:
    """The share of a mask's area, (H, W) uint8, in which a pixel and all its neighbours are half
    transparent.
    """
    within = erosion((alpha > HALF[0]) & (alpha < HALF[1]), np.ones((3, 3)))
    return float(within.sum() / max((alpha > MASK_THRESHOLD).sum(), 1))


def fits_turned(image: np.ndarray, turned: np.ndarray, mask: np.ndarray) -> float:
    """How many times better a mask (H, W) fits the second of two images (H, W, 4), judged by how
    much more their brightness changes at the mask's edge than elsewhere.
    """
    edge = dilation(mask > OPAQUE // 2) ^ erosion(mask > OPAQUE // 2)
    changes = (
        np.hypot(*np.gradient(picture[..., :3].mean(2))) + 1e-3 for picture in (image, turned)
    )
    before, after = (change[edge].mean() / change.mean() for change in changes)
    return float(after / before)
