"""What stands out from the background: a photograph against what others show of the wall behind the
object, which they see beside it; or at the same pixels, where the object turns before a wall that
stands still. Parts and gaps too thin for a cut by colour are found in this way.
"""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from pp_cl import track
from pp_cl.engine import evenly
from pp_studio.capture.packages import needed
from pp_studio.capture.window import Window, dilated

cv2 = needed("cv2")

NEAREST = 10  # photographs that one is compared with
STEP = 8  # pixels between places whose depth is interpolated
MARGIN = 0.1  # of a window's size: sparse points so far outside it still tell depths in it
LEAST, MOST = 50, 800  # sparse points behind a window: needed, and looked at
AMONG = 6  # points whose median depth each has, since some are wrong
HIDING = 2  # pixels around a mask that may show the object
UNSEEN = 255  # as a difference: no other photograph shows the background
# Of an object that turns
COMPARED = 64  # photographs that one is compared with
ALIKE, SLIGHT = 2.0, 3.0  # times what is usual, and levels: differences of the same still wall
LEAST_ALIKE = 5  # photographs that show the same
SHOWN = 0.15, 0.4, 0.9  # few, some and nearly all of them
BLUR = 2.0  # levels over which differences are counted
RARE = 1e-3  # share of the pixels that are spread over all levels


def differences(
    windows: Sequence[Window],
    background: np.ndarray,
    beside: Sequence[np.ndarray] | None = None,
) -> list[np.ndarray]:
    """For each window (H, W) uint8, by how many levels its most different channel differs from what
    others show of the background there; or UNSEEN.

    background: (N, 3) sparse points around the object. beside: where the object turns before a
    background that stands still, and that others show at the same pixels: (H, W) bool each, what
    surely shows it.
    """
    eyes = np.stack([one.camera.eye for one in windows])
    found = []
    for i, one in enumerate(track(windows, "backgrounds", "image")):
        order = np.argsort(np.linalg.norm(eyes - one.camera.eye, axis=1), kind="stable")
        others = [windows[k] for k in order[1:]]
        if beside is not None:
            found.append(_difference_of_still(one, evenly(others, COMPARED), beside[i]))
        else:
            found.append(_difference(one, others[:NEAREST], background))
    return found


def _difference(one, others, background):
    """From what the others show at the same places, beside their masks: the median."""
    places = _places_behind(one, background)
    height, width = one.mask.shape
    if places is None:
        return np.full((height, width), UNSEEN, np.uint8)
    rows, columns = places.shape[:2]
    found = []
    for other in others:
        at = other.pixels(places.reshape(-1, 3)).reshape(rows, columns, 2).astype(np.float32) - 0.5
        at = cv2.resize(np.nan_to_num(at, nan=-1e6), (width, height))
        found.append(_levels(one, other, at, ~dilated(other.mask, HIDING)))
    return _smallest(found, [0.5])[0]


def _difference_of_still(one, others, beside):
    """From those that show the same wall: what some of them do not exceed, whatever their masks
    say, as these may hold the gaps. UNSEEN where few show the same, the wall that is mostly hidden;
    or nearly all, as that may be a part of the object without a pattern.
    """
    found, off = [], []
    for other in others:
        levels = _levels(one, other, one.pixels_in(other), np.ones(other.mask.shape, bool))
        seen = beside & (levels < UNSEEN)
        found.append(levels)
        off.append(np.median(levels[seen]) if seen.any() else UNSEEN)
    least = np.sort(off)[:LEAST_ALIKE].mean()
    alike = min(max(SLIGHT, ALIKE * least), UNSEEN - 1)
    found = [levels for levels, by in zip(found, off, strict=True) if by <= alike]
    if len(found) < LEAST_ALIKE:
        return np.full(beside.shape, UNSEEN, np.uint8)
    few, some, nearly_all = _smallest(found, SHOWN)
    usual, most = (ALIKE * np.median(one[beside]) + SLIGHT for one in (some, nearly_all))
    rarely, always = (few <= usual) & (some > usual), nearly_all <= most
    some[rarely | (always & ~beside)] = UNSEEN
    return some


def _levels(one, other, at, usable):
    """(H, W) uint8 differences from what another window shows at places (H, W, 2) of its pixels
    that are usable, (H, W) bool of the other; elsewhere UNSEEN.
    """
    usable = cv2.remap(255 * usable.astype(np.uint8), at, None, cv2.INTER_LINEAR, borderValue=0)
    behind = cv2.remap(other.image, at, None, cv2.INTER_LINEAR)
    levels = np.maximum.reduce(cv2.split(cv2.absdiff(one.image, behind)))
    return np.where(usable == 255, np.minimum(levels, UNSEEN - 1), np.uint8(UNSEEN))


def _smallest(found, shares):
    """(H, W) uint8 each: the difference that a share of those that are seen do not exceed."""
    found = np.sort(np.stack(found, axis=-1), axis=-1)
    seen = (found < UNSEEN).sum(-1, keepdims=True)
    places = (np.maximum(np.ceil(share * seen).astype(int) - 1, 0) for share in shares)
    return [np.take_along_axis(found, at, axis=-1)[..., 0] for at in places]


def _places_behind(one, background):
    """(rows, columns, 3) world positions on the background, of pixels STEP apart, between the
    sparse points there; None where these are too few.
    """
    camera = one.camera
    size = np.array([camera.width, camera.height])
    depth = (background - camera.eye) @ camera.pose[:, 2]
    pixels = one.pixels(background)
    near = (depth > 0) & (abs(pixels / size - 0.5) < 0.5 + MARGIN).all(1)
    if near.sum() < LEAST:
        return None
    pixels, inverse = pixels[near], 1 / depth[near]
    corners = size * (np.indices((2, 2)).reshape(2, 4).T * (1 + 2 * MARGIN) - MARGIN)
    known = np.random.default_rng(0).permutation(pixels)[:MOST]
    known = np.concatenate([known, corners])
    nearest = cKDTree(pixels).query(known, AMONG)[1]
    between = LinearNDInterpolator(known, np.median(inverse[nearest], axis=1))
    columns, rows = -(-size // STEP)
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) * camera.width / columns,
        (np.arange(rows) + 0.5) * camera.height / rows,
    )
    ahead = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)
    along = np.stack(ahead, axis=-1) @ camera.pose[:, :3].T
    return camera.eye + along / between(x, y)[..., None]


def evidence(
    found: Sequence[np.ndarray], beside: Sequence[np.ndarray], surely: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """For each window (H, W) float32: how much likelier its differences are on the object than
    beside it, as a logarithm; 0 where they are UNSEEN.

    beside, surely: (H, W) bool each, what shows the background and the object for sure.
    What cannot be predicted says nothing: its differences are the same on both.
    """
    counts = np.zeros((2, UNSEEN + 1))
    for difference, *sides in zip(found, beside, surely, strict=True):
        for count, side in zip(counts, sides, strict=True):
            count += np.bincount(difference[side], minlength=UNSEEN + 1)
    shares = gaussian_filter1d(counts[:, :UNSEEN], BLUR, axis=1) + 1
    shares /= shares.sum(1, keepdims=True)
    off, on = np.log((1 - RARE) * shares + RARE / UNSEEN)
    odds = np.append(on - off, 0.0).astype(np.float32)
    return [odds[difference] for difference in found]
