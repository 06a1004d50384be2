"""What stands out from the background: a photograph against what others show of the wall behind the
object, which they see beside it. Parts too thin for a cut by colour are found in this way.
"""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from tqdm import tqdm

from pp_cl.capture.packages import needed
from pp_cl.capture.window import Window, dilated

cv2 = needed("cv2")

NEAREST = 10  # photographs that one is compared with
STEP = 8  # pixels between places whose depth is interpolated
MARGIN = 0.1  # of a window's size: sparse points so far outside it still tell depths in it
LEAST, MOST = 50, 800  # sparse points behind a window: needed, and looked at
AMONG = 6  # points whose median depth each has, since some are wrong
HIDING = 2  # pixels around a mask that may show the object
UNSEEN = 255  # as a difference: no other photograph shows the background
BLUR = 2.0  # levels over which differences are counted
RARE = 1e-3  # share of the pixels that are spread over all levels


def differences(windows: Sequence[Window], background: np.ndarray) -> list[np.ndarray]:
    """For each window (H, W) uint8, by how many levels its most different channel differs from what
    the nearest others show behind it, beside their masks, the median of these; or UNSEEN.

    background: (N, 3) sparse points around the object.
    """
    eyes = np.stack([one.camera.eye for one in windows])
    found = []
    for one in tqdm(windows, "backgrounds", unit="image", leave=False, disable=None):
        order = np.argsort(np.linalg.norm(eyes - one.camera.eye, axis=1), kind="stable")
        others = [windows[i] for i in order[1 : 1 + NEAREST]]
        found.append(_difference(one, others, background))
    return found


def _difference(one, others, background):
    places = _places_behind(one, background)
    height, width = one.mask.shape
    if places is None:
        return np.full((height, width), UNSEEN, np.uint8)
    rows, columns = places.shape[:2]
    found = np.full((len(others), height, width), UNSEEN, np.uint8)
    for differs, other in zip(found, others, strict=True):
        at = other.pixels(places.reshape(-1, 3)).reshape(rows, columns, 2).astype(np.float32) - 0.5
        at = cv2.resize(np.nan_to_num(at, nan=-1e6), (width, height))
        beside = 255 * (~dilated(other.mask, HIDING)).astype(np.uint8)
        is_seen = cv2.remap(beside, at, None, cv2.INTER_LINEAR, borderValue=0) == 255
        behind = cv2.remap(other.image, at, None, cv2.INTER_LINEAR)
        levels = np.maximum.reduce(cv2.split(cv2.absdiff(one.image, behind)))
        differs[is_seen] = np.minimum(levels, UNSEEN - 1)[is_seen]
    found = np.sort(found.reshape(len(others), -1).T)
    seen = (found < UNSEEN).sum(1)
    middle = found[np.arange(len(found)), np.maximum(seen - 1, 0) // 2]
    return middle.reshape(height, width)


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
    ahead = one.directions(x, y)
    return camera.eye + ahead @ camera.pose[:, :3].T / between(x, y)[..., None]


def evidence(
    found: Sequence[np.ndarray], windows: Sequence[Window], surely: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """For each window (H, W) float32: how much likelier its differences are on the object than
    beside the masks, as a logarithm; 0 where they are UNSEEN.

    surely: (H, W) bool each, what shows the object for sure; masks may hold gaps between its parts.
    What cannot be predicted says nothing: its differences are the same on the masks and beside.
    """
    counts = np.zeros((2, UNSEEN + 1))
    for difference, one, on in zip(found, windows, surely, strict=True):
        counts[0] += np.bincount(difference[~one.mask], minlength=UNSEEN + 1)
        counts[1] += np.bincount(difference[on], minlength=UNSEEN + 1)
    shares = gaussian_filter1d(counts[:, :UNSEEN], BLUR, axis=1) + 1
    shares /= shares.sum(1, keepdims=True)
    beside, on = np.log((1 - RARE) * shares + RARE / UNSEEN)
    odds = np.append(on - beside, 0.0).astype(np.float32)
    return [odds[difference] for difference in found]
