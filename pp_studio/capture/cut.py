"""Cuts an object out of photographs with known cameras. GrabCut cuts each view, with colours that
all views share: first from the sparse points, then with the pixels that stand out from the
background, then after a vote of the views by a forgiving hull.

To find pixels that stand out, a photograph is compared with the background that other photographs
show beside the object, or at the same pixels if the object turns before a still background. This
finds parts and gaps that are too thin for a cut by colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from pp_cl import Camera, Progress, track
from pp_cl.engine import Grid, evenly, smallest_voxel_size
from pp_cl.errors import UserError
from pp_cl.scene import ImageFile
from pp_studio.capture.box import corners_of
from pp_studio.capture.packages import needed

cv2 = needed("cv2")

CUT_SIDE = 400  # longer side, pixels, of the image that is cut: the projected box and its margin
AROUND = 0.2  # of the projected box: margin on each side, which shows the background
# Of the box's diagonal: lower points may lie on the object's support or on things around it. The
# object's own lowest points are at 0.05, since box.MARGIN lies below them.
FOOT = 0.08
SEED = 1 / 150  # radius of a sparse point, of CUT_SIDE
ROUGH = 2  # pixels at the border of certain object regions that may show the background
NEAR = 1 / 20  # of CUT_SIDE: between sparse points so close there is a surface
SAMPLES = 160  # squared: pixels from which the colours of each side are learned
FITTED = 3  # times that the colours are fitted to their samples
ISLAND = 0.02  # of the largest region of a mask; smaller regions are dropped
ROUNDS = 2  # of votes
STANDS_OUT, IS_WALL = 3.0, -4.0  # log-odds above and below which colours are overruled
LIKE_WALL = -2.0  # log-odds below which not even nearly all other views are believed
CROWDED = 0.3  # share of 3x3 pixels like the background; on the object only single pixels are
CELLS = 112**3  # vertices on which views vote
FORGIVEN = 0.15  # share of the views that see a vertex whose masks may reject it
SLIPS = 0.08  # the same: if no more masks reject it, these are cut wrongly; but see LIKE_WALL
LEAST_SEEING = 3  # views that must see a vertex, or all if there are fewer
# A side of the box cuts the object if its outermost layer holds TOUCHING times the vertices of the
# fullest layer. Then it moves out by GROWTH of the box's diagonal, at most GROWTHS times.
TOUCHING, GROWTH, GROWTHS = 0.03, 0.05, 4
MOSTLY_SEEN = 0.5  # of the windows
SOFT = 1.0  # pixels of the cut image over which a border is refined
FLAT = 1e-3  # variance of colours, of 1, below which a border follows no edge
# To find pixels that stand out
NEAREST = 10  # photographs with which a photograph is compared
STEP = 8  # pixels between places whose depth is interpolated
MARGIN = 0.1  # of a window's size: sparse points so far outside it still give depths in it
LEAST, MOST = 50, 800  # sparse points behind a window: needed, and used
AMONG = 6  # neighbours whose median depth a point gets, since some points are wrong
HIDING = 2  # pixels around a mask that may show the object
UNSEEN = 255  # in place of a difference: no other photograph shows the background
# If the object turns
COMPARED = 64  # photographs with which a photograph is compared
ALIKE, SLIGHT = 2.0, 3.0  # times the usual difference, and levels, for the same still background
LEAST_ALIKE = 5  # photographs that show the same background
SHOWN = 0.15, 0.4, 0.9  # few, some and nearly all of them
BLUR = 2.0  # levels over which differences are counted
RARE = 1e-3  # share of the pixels that are spread over all levels


@dataclass(eq=False)
class Window:
    """The part of a photograph around the projected box, reduced for cutting.

    image: (H, W, 3) uint8. camera: the image's camera. place: (x0, y0, x1, y1) in the photograph.
    mask: (H, W) bool, None until it is known.
    """

    name: str
    image: np.ndarray
    camera: Camera
    place: tuple[int, int, int, int]
    mask: Any = None

    def pixels(self, positions: np.ndarray) -> np.ndarray:
        """(N, 2) x and y of world positions (N, 3); NaN behind the camera."""
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y, depth = self.camera.project(positions)
        return np.where(depth > 0, [x, y], np.nan).T

    def reduced(self, image: np.ndarray) -> np.ndarray:
        """The window's part of an image of the photograph's size, (H, W) or (H, W, C), reduced."""
        x0, y0, x1, y1 = self.place
        size = self.camera.width, self.camera.height
        return cv2.resize(image[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)

    def inside(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """((M,) indices of the positions that the image shows, their rows, their columns)."""
        column, row, is_shown = self.camera.pixels(positions)
        return np.flatnonzero(is_shown), row[is_shown], column[is_shown]

    def marked(self, positions: np.ndarray) -> np.ndarray:
        """(H, W) bool: the pixels that show world positions (N, 3)."""
        _, rows, columns = self.inside(positions)
        shown = np.zeros(self.image.shape[:2], bool)
        shown[rows, columns] = True
        return shown


def place_of(image_file: ImageFile, box: np.ndarray) -> tuple[int, int, int, int] | None:
    """(x0, y0, x1, y1) around the box (2, 3) in a photograph; None if the box is outside."""
    camera = image_file.camera
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, depth = camera.project(corners_of(box))
    if depth.min() <= 0:  # the box is around the camera
        x, y = np.array([0, camera.width]), np.array([0, camera.height])
    if x.max() < 1 or y.max() < 1 or x.min() > camera.width - 1 or y.min() > camera.height - 1:
        return None
    (x0, x1), (y0, y1) = _grown(x, camera.width), _grown(y, camera.height)
    return x0, y0, x1, y1


def window(image: np.ndarray, image_file: ImageFile, box: np.ndarray) -> Window:
    """The Window of a photograph, (H, W, 3) uint8. Raises UserError if the box is outside."""
    place = place_of(image_file, box)
    if place is None:
        raise UserError(f"{image_file.name}: the object's box is outside; give another with --box")
    x0, y0, x1, y1 = place
    scale = min(1, CUT_SIDE / max(x1 - x0, y1 - y0))
    width, height = (max(2, round(scale * n)) for n in (x1 - x0, y1 - y0))
    sx, sy = width / (x1 - x0), height / (y1 - y0)
    camera = image_file.camera.crop(x0, y0, width, height)
    camera = replace(
        camera, fx=sx * camera.fx, fy=sy * camera.fy, cx=sx * camera.cx, cy=sy * camera.cy
    )
    unreduced = Window(image_file.name, image, camera, place)
    return replace(unreduced, image=unreduced.reduced(image))


def _grown(places, size):
    """(first, last + 1) pixel of places, widened by AROUND, within an image of `size` pixels."""
    margin = AROUND * np.ptp(places)
    return max(0, int(places.min() - margin)), min(size, int(places.max() + margin) + 1)


def dilated(marked: np.ndarray, radius: int) -> np.ndarray:
    """(H, W) bool: the marked pixels and all pixels within a radius of them."""
    return cv2.dilate(marked.astype(np.uint8), disc(radius)) > 0


def disc(radius: int) -> np.ndarray:
    """A filled circle for OpenCV's morphology."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def are_inside(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(N,) bool, which of the points (N, 3) lie in a box (2, 3)."""
    return ((points > box[0]) & (points < box[1])).all(1)


def cut_out_all(
    windows: Sequence[Window],
    box: np.ndarray,
    points: np.ndarray,
    seen: Sequence[np.ndarray],
    turns: bool,
) -> None:
    """Set the masks of the windows that have none. box, points, seen, turns: as in write_masks().
    Raises UserError for a box without an object.
    """
    cv2.setNumThreads(1)
    inside = are_inside(points, box)
    unmasked = [i for i, window in enumerate(windows) if window.mask is None]
    labels = [
        _seeds(window, box, points, inside, visible)
        if window.mask is None
        else window.mask.astype(np.uint8)
        for window, visible in zip(track(windows, "finding the object", "image"), seen, strict=True)
    ]
    seeds = list(labels)
    if not any((label & 1).any() for label in labels):  # the lowest bit marks the object
        raise UserError(
            "no point lies in the object's box above what it stands on; give another with --box"
        )

    def cut(number):
        text = f"cutting out, {number} of {2 + ROUNDS}"
        with Progress(text):
            colours = _colours(windows, labels)
        for i in track(unmasked, text, "image"):
            label, (background, front) = labels[i].copy(), (mixture.copy() for mixture in colours)
            how = cv2.GC_EVAL_FREEZE_MODEL  # keeps the colours
            cv2.grabCut(windows[i].image, label, None, background, front, 1, how)
            windows[i].mask = label & 1 == 1

    cut(1)
    around = [label == cv2.GC_BGD for label in labels]

    def beside():
        return [
            background & ~window.mask for background, window in zip(around, windows, strict=True)
        ]

    levels = differences(windows, points[~inside], beside() if turns else None)
    agreed = [np.zeros(label.shape, bool) for label in labels]  # object, say nearly all views
    for number in range(1 + ROUNDS):
        if number:
            hull = forgiving_hull(windows, box)
            for i in track(unmasked, f"voting, {number} of {ROUNDS}", "image"):
                labels[i], agreed[i] = _relabelled(windows[i], seeds[i], *hull)
        surely = [_eroded(label == cv2.GC_FGD, ROUGH) for label in labels]
        with Progress("what stands out"):
            standing_out = evidence(levels, beside(), surely)
        for i in unmasked:  # pixels that clearly stand out, or do not, are no longer open
            label, wall = labels[i].copy(), standing_out[i] < IS_WALL
            crowded = cv2.blur(wall.astype(np.float32), (3, 3)) > CROWDED
            label[(standing_out[i] > STANDS_OUT) & (label != cv2.GC_BGD)] = cv2.GC_FGD
            label[agreed[i] & (standing_out[i] >= LIKE_WALL)] = cv2.GC_FGD
            label[wall & crowded & (label != cv2.GC_FGD)] = cv2.GC_BGD
            labels[i] = label
        cut(2 + number)
    for i in unmasked:
        windows[i].mask = without_islands(windows[i].mask)


def grown_box(windows: Sequence[Window], box: np.ndarray) -> np.ndarray | None:
    """(2, 3) box whose sides are moved outwards where they cut the object, except below; None if no
    side does. The object is the part of the masks' hull that most windows see, since hardly any
    mask bounds the rest.
    """
    hull, _, seeing, voxel_size = forgiving_hull(windows, box)
    hull = hull[seeing >= MOSTLY_SEEN * len(windows)]
    if not len(hull):
        return None
    grown, by = box.copy(), GROWTH * np.linalg.norm(box[1] - box[0])
    for axis in range(3):
        _, layer = np.unique(hull[:, axis].round(6), return_inverse=True)
        least = TOUCHING * np.bincount(layer).max()
        for side, sign in ((0, -1), (1, 1)):
            touching = (np.abs(hull[:, axis] - box[side, axis]) <= voxel_size / 2).sum()
            if touching > least and (side, axis) != (0, 2):
                grown[side, axis] += sign * by
    return None if (grown == box).all() else grown


def without_islands(mask: np.ndarray) -> np.ndarray:
    """(H, W) bool: the mask without regions smaller than ISLAND times the largest, which are mostly
    things near the object in its colours.
    """
    _, regions, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = facts[:, cv2.CC_STAT_AREA]
    areas[0] = 0  # the background
    return (areas >= max(1, ISLAND * areas.max()))[regions]


def _seeds(window, box, points, inside, visible):
    """(H, W) uint8 GrabCut labels from the box and the sparse points in a photograph."""
    labels = np.full(window.image.shape[:2], cv2.GC_BGD, np.uint8)
    outline = window.pixels(corners_of(box))
    if np.isnan(outline).any():
        labels[:] = cv2.GC_PR_BGD
    else:
        outline = cv2.convexHull(outline.astype(np.float32)).round().astype(np.int32)
        cv2.fillConvexPoly(labels, outline, cv2.GC_PR_BGD)
    radius = max(1, round(SEED * CUT_SIDE))
    foot = box[0, 2] + FOOT * np.linalg.norm(box[1] - box[0])
    near = dilated(window.marked(points[inside & (points[:, 2] > foot)]), radius)
    near = _closed(near, round(NEAR * CUT_SIDE))
    labels[near & (labels == cv2.GC_PR_BGD)] = cv2.GC_PR_FGD
    sure = visible[inside[visible] & (points[visible, 2] > foot)]
    labels[dilated(window.marked(points[visible[~inside[visible]]]), radius)] = cv2.GC_BGD
    labels[dilated(window.marked(points[sure]), radius)] = cv2.GC_FGD
    return labels


def _eroded(marked, radius):
    return cv2.erode(marked.astype(np.uint8), disc(radius)) > 0


def _closed(marked, radius):
    """(H, W) bool with gaps narrower than two radii closed; beyond the border all is unmarked."""
    padded = np.pad(marked.astype(np.uint8), radius)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc(radius))
    return closed[radius:-radius, radius:-radius] > 0


def _colours(windows, labels):
    """GrabCut's mixtures of (background, object) colours in all windows, (1, 65) each."""
    rng, drawn = np.random.default_rng(0), []
    each = -(-(SAMPLES**2) // len(windows))
    for wanted in (0, 1):  # the lowest bit of a label
        of = [
            window.image[label & 1 == wanted] for window, label in zip(windows, labels, strict=True)
        ]
        colours = np.concatenate([f[rng.integers(0, len(f), each)] for f in of if len(f)])
        drawn.append(colours[rng.integers(0, len(colours), SAMPLES**2)])
    image = np.concatenate(drawn).reshape(2 * SAMPLES, SAMPLES, 3)
    sure = np.zeros(image.shape[:2], np.uint8)
    sure[:SAMPLES], sure[SAMPLES:] = cv2.GC_BGD, cv2.GC_FGD
    background, front = np.zeros((2, 1, 65))
    cv2.setRNGSeed(0)
    cv2.grabCut(image, sure, None, background, front, FITTED, cv2.GC_INIT_WITH_MASK)
    return background, front


def forgiving_hull(
    windows: Sequence[Window], box: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """((N, 3) positions in the box that are rejected by at most FORGIVEN of the masks whose windows
    see them, (N,) number of rejections, (N,) number of windows that see them, their spacing).
    """
    grid = Grid.centred_in(box, smallest_voxel_size(box, CELLS))
    positions = grid.lattice()
    seeing, rejected = np.zeros((2, len(positions)), np.int32)
    most, candidates = int(FORGIVEN * len(windows)), np.arange(len(positions))
    for window in track(windows, "what the masks agree on", "image"):
        shown, rows, columns = window.inside(positions[candidates])
        seeing[candidates[shown]] += 1
        rejected[candidates[shown]] += ~window.mask[rows, columns]
        candidates = candidates[rejected[candidates] <= most]
    seeing, rejected = seeing[candidates], rejected[candidates]
    in_hull = (seeing >= min(LEAST_SEEING, len(windows))) & (rejected <= FORGIVEN * seeing)
    if not in_hull.any():
        raise UserError(
            "the photographs have no part of the box in common that stands out from what is behind"
            " it; give masks with --masks, or another box with --box"
        )
    return positions[candidates[in_hull]], rejected[in_hull], seeing[in_hull], grid.voxel_size


def _relabelled(window, seeds, hull, rejections, seeing, voxel_size):
    """((H, W) uint8 GrabCut labels from the hull and its part that no other view rejects, (H, W)
    bool: the part that hardly any other view rejects).
    """
    gap = gap_of(window, hull, voxel_size)
    shown, rows, columns = window.inside(hull)
    others = rejections[shown] - ~window.mask[rows, columns]

    def core(most):
        return _eroded(silhouette(window, hull[shown[others <= most]], gap), 2 * gap + 1)

    held = silhouette(window, hull, gap)
    labels = np.where(held & window.mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[_eroded(held, gap) & (seeds == cv2.GC_FGD)] = cv2.GC_FGD
    labels[seeds == cv2.GC_BGD] = cv2.GC_BGD
    labels[~dilated(held, 2 * gap)] = cv2.GC_BGD
    labels[core(0)] = cv2.GC_FGD
    return labels, core(SLIPS * seeing[shown])


def gap_of(one: Window, hull: np.ndarray, voxel_size: float) -> int:
    """Pixels between neighbouring vertices of a hull, (N, 3) with this voxel_size, in a window."""
    middle = np.linalg.norm(hull.mean(0) - one.camera.eye)
    return max(1, int(np.ceil(voxel_size * one.camera.fx / middle)))


def silhouette(one: Window, hull: np.ndarray, gap: int) -> np.ndarray:
    """(H, W) bool: where a window shows vertices of a hull (N, 3), which are `gap` pixels apart."""
    return _closed(one.marked(hull), gap)


def whole_mask(one: Window, image: np.ndarray) -> np.ndarray:
    """(H, W) uint8 mask of the whole photograph (H, W, 3): the window's mask, with a border that
    follows the photograph's edges (guided filter, He et al. 2010) and is as soft as they are.
    """
    x0, y0, x1, y1 = one.place
    guide = image[y0:y1, x0:x1].astype(np.float32) / 255
    rough = cv2.resize(one.mask.astype(np.float32), (x1 - x0, y1 - y0))
    side = 2 * max(1, round(SOFT * (x1 - x0) / one.mask.shape[1])) + 1

    def mean(values):
        return cv2.blur(values, (side, side), borderType=cv2.BORDER_REFLECT)

    colour, level = mean(guide), mean(rough)
    band = (level > 0) & (level < 1)
    products = [mean(guide * guide[..., c : c + 1])[band] for c in range(3)]
    variance = np.stack(products, axis=1) - colour[band][:, None] * colour[band][..., None]
    along = mean(guide * rough[..., None])[band] - colour[band] * level[band][:, None]
    coefficients = np.zeros_like(guide)
    coefficients[band] = np.linalg.solve(variance + FLAT * np.eye(3), along[..., None])[..., 0]
    refined = (mean(coefficients) * guide).sum(2) + mean(level - (coefficients * colour).sum(2))
    mask = np.zeros(image.shape[:2], np.uint8)
    mask[y0:y1, x0:x1] = np.clip(255 * refined + 0.5, 0, 255)
    return mask


def differences(
    windows: Sequence[Window],
    background: np.ndarray,
    beside: Sequence[np.ndarray] | None = None,
) -> list[np.ndarray]:
    """For each window (H, W) uint8: the levels by which its most different channel differs from the
    background that other windows show at the same place; or UNSEEN.

    background: (N, 3) sparse points around the object. beside: if the object turns before a still
    background, which others show at the same pixels: (H, W) bool for each window, the pixels that
    surely show it.
    """
    eyes = np.stack([window.camera.eye for window in windows])
    levels = []
    for i, window in enumerate(track(windows, "backgrounds", "image")):
        order = np.argsort(np.linalg.norm(eyes - window.camera.eye, axis=1), kind="stable")
        others = [windows[k] for k in order[1:]]
        if beside is not None:
            levels.append(_difference_of_still(window, evenly(others, COMPARED), beside[i]))
        else:
            levels.append(_difference(window, others[:NEAREST], background))
    return levels


def _difference(window, others, background):
    """The median difference from the background that others show beside their masks."""
    places = _places_behind(window, background)
    if places is None:
        return np.full(window.mask.shape, UNSEEN, np.uint8)
    levels = []
    for other in others:
        at = other.pixels(places.reshape(-1, 3)).reshape(*places.shape[:2], 2)
        at = np.nan_to_num(at.astype(np.float32) - 0.5, nan=-1e6)
        at = cv2.resize(at, window.mask.shape[::-1])
        levels.append(_levels(window, other, at, ~dilated(other.mask, HIDING)))
    return _smallest(levels, [0.5])[0]


def _difference_of_still(window, others, beside):
    """The difference that some of the others with the same still background do not exceed; their
    masks do not matter.
    """
    of_others, off = [], []
    for other in others:
        at = []  # x and y of this window's pixels in the other window, at the same pixels
        for axis in (0, 1):
            (begin, end), (first, last) = window.place[axis::2], other.place[axis::2]
            size, there = window.image.shape[1 - axis], other.image.shape[1 - axis]
            places = begin + (np.arange(size) + 0.5) * (end - begin) / size
            at.append((places - first) * there / (last - first) - 0.5)
        same = np.stack(np.meshgrid(*at), axis=-1).astype(np.float32)
        levels = _levels(window, other, same, np.ones(other.mask.shape, bool))
        visible = beside & (levels < UNSEEN)
        of_others.append(levels)
        off.append(np.median(levels[visible]) if visible.any() else UNSEEN)
    least = np.sort(off)[:LEAST_ALIKE].mean()
    alike = min(max(SLIGHT, ALIKE * least), UNSEEN - 1)
    of_others = [levels for levels, by in zip(of_others, off, strict=True) if by <= alike]
    if len(of_others) < LEAST_ALIKE:
        return np.full(beside.shape, UNSEEN, np.uint8)
    few, some, nearly_all = _smallest(of_others, SHOWN)
    usual, most = (ALIKE * np.median(levels[beside]) + SLIGHT for levels in (some, nearly_all))
    # few others show a mostly hidden wall; nearly all show a part of the object without a pattern
    rarely, always = (few <= usual) & (some > usual), nearly_all <= most
    some[rarely | (always & ~beside)] = UNSEEN
    return some


def _levels(window, other, at, usable):
    """(H, W) uint8 differences from another window's pixels at (H, W, 2); UNSEEN if not usable."""
    usable = cv2.remap(255 * usable.astype(np.uint8), at, None, cv2.INTER_LINEAR, borderValue=0)
    behind = cv2.remap(other.image, at, None, cv2.INTER_LINEAR)
    levels = np.maximum.reduce(cv2.split(cv2.absdiff(window.image, behind)))
    return np.where(usable == 255, np.minimum(levels, UNSEEN - 1), np.uint8(UNSEEN))


def _smallest(levels, shares):
    """(H, W) uint8 for each share: the level that this share of seen differences do not exceed."""
    levels = np.sort(np.stack(levels, axis=-1), axis=-1)
    count = (levels < UNSEEN).sum(-1, keepdims=True)
    places = (np.maximum(np.ceil(share * count).astype(int) - 1, 0) for share in shares)
    return [np.take_along_axis(levels, at, axis=-1)[..., 0] for at in places]


def _places_behind(window, background):
    """(rows, columns, 3) positions interpolated between background points; None if they are few."""
    camera = window.camera
    size = np.array([camera.width, camera.height])
    depth = (background - camera.eye) @ camera.pose[:, 2]
    pixels = window.pixels(background)
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
    """For each window (H, W) float32: the logarithm of how much likelier its differences are on the
    object than beside it; 0 where they are UNSEEN.

    beside, surely: (H, W) bool each, pixels that surely show the background and the object. An
    unpredictable background decides nothing, as its differences are the same on both.
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
