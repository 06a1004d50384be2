"""Cuts an object out of photographs with known cameras: GrabCut by view, with colours that all
views share, from the sparse points, then by what stands out from the background, then by a vote of
the views with a forgiving hull.
"""

from collections.abc import Sequence

import numpy as np

from pp_cl import track
from pp_cl.engine import Grid, smallest_voxel_size
from pp_cl.errors import UserError
from pp_studio.capture import backdrop
from pp_studio.capture.box import corners_of
from pp_studio.capture.packages import needed
from pp_studio.capture.window import CUT_SIDE, Window, dilated, disc

cv2 = needed("cv2")

# Of the box's diagonal: points lower in it may be on what the object stands on, or on what lies
# around it. The object's own lowest are at 0.05, as box.MARGIN is below them.
FOOT = 0.08
SEED = 1 / 150  # radius of a sparse point, of CUT_SIDE
ROUGH = 2  # pixels at the border of what is surely the object that may show the background
NEAR = 1 / 20  # of CUT_SIDE: sparse points so close show a surface between them
SAMPLES = 160  # squared: pixels of each side that the colours are learned from
FITTED = 3  # times that the colours are fitted to their samples
ISLAND = 0.02  # of the largest region: smaller ones of a mask are dropped
ROUNDS = 2  # of votes
STANDS_OUT, IS_WALL = 3.0, -4.0  # log-odds above and below which colours are overruled
CROWDED = 0.3  # of 3x3 pixels that look like the background: the object has single ones
CELLS = 112**3  # vertices that are voted on
FORGIVEN = 0.15  # of the views that see a vertex: their masks may reject it
LEAST_SEEING = 3  # views that see a vertex, or all of fewer
# A side of the box cuts the object if its outermost layer holds this share of the vertices of the
# fullest one: then it moves out by so much of the box's diagonal, at most so often.
TOUCHING, GROWTH, GROWTHS = 0.03, 0.05, 4
MOSTLY_SEEN = 0.5  # of the windows
SOFT = 1.0  # pixels of the cut image over which a border is refined
FLAT = 1e-3  # variance of colours, of 1, below which a border follows no edge


def cut_out_all(
    windows: Sequence[Window],
    box: np.ndarray,
    points: np.ndarray,
    inside: np.ndarray,
    seen: Sequence[np.ndarray],
    turns: bool,
) -> None:
    """Set the masks of the windows that have none. Raises UserError for a box in which nothing
    stands.

    box, points, seen, turns: as write_masks() takes them. inside: (N,) bool, the object's points.
    """
    cv2.setNumThreads(1)
    left = [i for i, one in enumerate(windows) if one.mask is None]
    seeds = {i: _seeds(windows[i], box, points, inside, seen[i]) for i in left}
    labels = [
        seeds[i] if i in seeds else one.mask.astype(np.uint8) for i, one in enumerate(windows)
    ]

    if not any((label & 1).any() for label in labels):  # the lowest bit: it is the object's
        raise UserError(
            "no point lies in the object's box above what it stands on; give another with --box"
        )

    def cut(number):
        colours, text = _colours(windows, labels), f"cutting out, {number} of {2 + ROUNDS}"
        for i in track(left, text, "image"):
            windows[i].mask = _grab_cut(windows[i], labels[i], colours)

    cut(1)
    around = [some == cv2.GC_BGD for some in labels]

    def beside():
        return [some & ~one.mask for some, one in zip(around, windows, strict=True)]

    differences = backdrop.differences(windows, points[~inside], beside() if turns else None)
    for number in range(1 + ROUNDS):
        if number:
            hull = forgiving_hull(windows, box)
            for i in left:
                labels[i] = _relabelled(windows[i], seeds[i], *hull)
        surely = [_eroded(some == cv2.GC_FGD, ROUGH) for some in labels]
        standing_out = backdrop.evidence(differences, beside(), surely)
        for i in left:
            labels[i] = _marked(labels[i], standing_out[i])
        cut(2 + number)
    for i in left:
        windows[i].mask = without_islands(windows[i].mask)


def grown_box(windows: Sequence[Window], box: np.ndarray) -> np.ndarray | None:
    """(2, 3) box whose sides are moved out where they cut the object off, but for what it stands
    on; None where no side does. The object is the hull of the masks as far as most windows see it,
    as beyond that hardly any mask bounds it.
    """
    hull, _, voxel_size = forgiving_hull(windows, box)
    seen = np.bincount(np.concatenate([one.inside(hull)[0] for one in windows]), None, len(hull))
    hull = hull[seen >= MOSTLY_SEEN * len(windows)]
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
    """(H, W) bool: the mask but for regions smaller than ISLAND times the largest, which are mostly
    things beside the object in its colours.
    """
    _, regions, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = facts[:, cv2.CC_STAT_AREA]
    areas[0] = 0  # the background
    return (areas >= max(1, ISLAND * areas.max()))[regions]


def _seeds(one, box, points, inside, seen):
    """(H, W) uint8 of GrabCut's labels: points of the object that the photograph shows, those of
    the background, what is outside the box; what is close to the object's points is probable.
    """
    labels = np.full(one.image.shape[:2], cv2.GC_BGD, np.uint8)
    outline = one.pixels(corners_of(box))
    if np.isnan(outline).any():
        labels[:] = cv2.GC_PR_BGD
    else:
        outline = cv2.convexHull(outline.astype(np.float32)).round().astype(np.int32)
        cv2.fillConvexPoly(labels, outline, cv2.GC_PR_BGD)
    radius = max(1, round(SEED * CUT_SIDE))
    foot = box[0, 2] + FOOT * np.linalg.norm(box[1] - box[0])
    near = _dots(one, points[inside & (points[:, 2] > foot)], radius)
    near = _closed(near, round(NEAR * CUT_SIDE))
    labels[near & (labels == cv2.GC_PR_BGD)] = cv2.GC_PR_FGD
    shown_inside = inside[seen]
    sure = seen[shown_inside & (points[seen, 2] > foot)]
    labels[_dots(one, points[seen[~shown_inside]], radius)] = cv2.GC_BGD
    labels[_dots(one, points[sure], radius)] = cv2.GC_FGD
    return labels


def _dots(one, positions, radius):
    """(H, W) bool: discs around the pixels that show world positions (N, 3)."""
    return dilated(one.marked(positions), radius)


def _eroded(marked, radius):
    return cv2.erode(marked.astype(np.uint8), disc(radius)) > 0


def _closed(marked, radius):
    """(H, W) bool with gaps narrower than two radii closed; nothing is beyond the border."""
    padded = np.pad(marked.astype(np.uint8), radius)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc(radius))
    return closed[radius:-radius, radius:-radius] > 0


def _colours(
    windows: Sequence[Window], labels: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """(the background's, the object's) colours, (1, 65) float64 each: GrabCut's mixture of five
    normal distributions, fitted to SAMPLES^2 pixels of all windows.
    """
    rng, drawn = np.random.default_rng(0), []
    each = -(-(SAMPLES**2) // len(windows))
    for wanted in (0, 1):  # the lowest bit of a label
        of = [one.image[label & 1 == wanted] for one, label in zip(windows, labels, strict=True)]
        found = np.concatenate([f[rng.integers(0, len(f), each)] for f in of if len(f)])
        drawn.append(found[rng.integers(0, len(found), SAMPLES**2)])
    image = np.concatenate(drawn).reshape(2 * SAMPLES, SAMPLES, 3)
    sure = np.zeros(image.shape[:2], np.uint8)
    sure[:SAMPLES], sure[SAMPLES:] = cv2.GC_BGD, cv2.GC_FGD
    background, front = np.zeros((2, 1, 65))
    cv2.setRNGSeed(0)
    cv2.grabCut(image, sure, None, background, front, FITTED, cv2.GC_INIT_WITH_MASK)
    return background, front


def _grab_cut(one, labels, colours):
    """(H, W) bool: the object, by colours that are not changed."""
    labels, (background, front) = labels.copy(), (some.copy() for some in colours)
    how = cv2.GC_EVAL_FREEZE_MODEL
    cv2.grabCut(one.image, labels, None, background, front, 1, how)
    return labels & 1 == 1


def forgiving_hull(
    windows: Sequence[Window], box: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """((N, 3) positions in the box that no more than FORGIVEN of the masks reject of the windows
    that see them, (N,) how many do, the positions' spacing).
    """
    grid = Grid.centred_in(box, smallest_voxel_size(box, CELLS))
    positions = grid.lattice()
    seen, rejected = np.zeros((2, len(positions)), np.int32)
    most, left = int(FORGIVEN * len(windows)), np.arange(len(positions))
    for one in windows:
        found, rows, columns = one.inside(positions[left])
        seen[left[found]] += 1
        rejected[left[found]] += ~one.mask[rows, columns]
        left = left[rejected[left] <= most]
    seen, rejected = seen[left], rejected[left]
    in_hull = (seen >= min(LEAST_SEEING, len(windows))) & (rejected <= FORGIVEN * seen)
    if not in_hull.any():
        raise UserError(
            "the photographs have no part of the box in common that stands out from what is behind"
            " it; give masks with --masks, or another box with --box"
        )
    return positions[left[in_hull]], rejected[in_hull], grid.voxel_size


def _relabelled(one, seeds, hull, rejections, voxel_size):
    """(H, W) uint8 of GrabCut's labels of a window from what all views agree on: what is well
    outside the hull is background, what is well within what no other view rejects is the object.
    """
    gap = gap_of(one, hull, voxel_size)
    found, rows, columns = one.inside(hull)
    agreed = found[rejections[found] == ~one.mask[rows, columns]]
    held, core = silhouette(one, hull, gap), silhouette(one, hull[agreed], gap)
    labels = np.where(held & one.mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[_eroded(held, gap) & (seeds == cv2.GC_FGD)] = cv2.GC_FGD
    labels[seeds == cv2.GC_BGD] = cv2.GC_BGD
    labels[~dilated(held, 2 * gap)] = cv2.GC_BGD
    labels[_eroded(core, 2 * gap + 1)] = cv2.GC_FGD
    return labels


def gap_of(one: Window, hull: np.ndarray, voxel_size: float) -> int:
    """Pixels between the vertices of a hull, (N, 3) of this voxel_size, in a window."""
    middle = np.linalg.norm(hull.mean(0) - one.camera.eye)
    return max(1, int(np.ceil(voxel_size * one.camera.fx / middle)))


def silhouette(one: Window, hull: np.ndarray, gap: int) -> np.ndarray:
    """(H, W) bool: where a window shows vertices of a hull (N, 3), so many pixels apart."""
    return _closed(one.marked(hull), gap)


def _marked(labels, standing_out):
    """The labels, where what stands out from the background, or does not, is no longer open."""
    labels = labels.copy()
    labels[(standing_out > STANDS_OUT) & (labels != cv2.GC_BGD)] = cv2.GC_FGD
    wall = standing_out < IS_WALL
    crowded = cv2.blur(wall.astype(np.float32), (3, 3)) > CROWDED
    labels[wall & crowded & (labels != cv2.GC_FGD)] = cv2.GC_BGD
    return labels


def whole_mask(one: Window, image: np.ndarray) -> np.ndarray:
    """(H, W) uint8 mask of the whole photograph (H, W, 3): the window's, whose border follows the
    photograph's edges (guided filter, He et al. 2010) and is soft where they are.
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
