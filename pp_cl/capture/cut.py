"""Cuts an object out of photographs with known cameras: GrabCut by view, with colours that all
views share, from the sparse points, then two rounds in which the views vote by a forgiving hull.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tqdm import tqdm

from pp_cl.capture.packages import needed
from pp_cl.errors import UserError
from pp_cl.scene.bounds import corners_of
from pp_cl.scene.camera import Camera
from pp_cl.scene.distortion import Distortion
from pp_cl.scene.grid import Grid, smallest_edge
from pp_cl.scene.views import Photograph

cv2 = needed("cv2")

CUT_SIDE = 400  # pixels of what is cut: the projected box and what is around it
AROUND = 0.2  # of the projected box, on each side: shows what the background looks like
FOOT = 0.04  # of the box's diagonal: points lower in it may be on what the object stands on
SEED = 1 / 150  # radius of a sparse point, of CUT_SIDE
NEAR = 1 / 20  # of CUT_SIDE: sparse points so close show a surface between them
SAMPLES = 160  # squared: pixels of each side that the colours are learned from
FITTED = 3  # times that the colours are fitted to their samples
ISLAND = 0.02  # of the largest region: smaller ones of a mask are dropped
ROUNDS = 2  # of votes
CELLS = 112**3  # vertices that are voted on
FORGIVEN = 0.15  # of the views that see a vertex: their masks may reject it
LEAST_SEEING = 3  # views that see a vertex, or all of fewer
BEYOND = 0.5  # of an image's size: further out a lens model says nothing
SOFT = 1.5  # pixels of the cut image over which a border is refined
FLAT = 1e-4  # variance of brightness, of 1, below which a border follows no edge


@dataclass(eq=False)
class Window:
    """The part of a photograph around the projected box, reduced for cutting.

    image: (H, W, 3) uint8. camera: of it. place: (x0, y0, x1, y1) in the photograph. mask: (H, W)
    bool, None until it is known.
    """

    name: str
    image: np.ndarray
    camera: Camera
    distortion: Distortion
    place: tuple[int, int, int, int]
    mask: Any = None

    def pixels(self, positions: np.ndarray) -> np.ndarray:
        """(N, 2) x and y of world positions (N, 3); NaN far outside the image."""
        c = self.camera
        right, down, depth = c.pose[:, :3].T @ (positions - c.eye).T
        depth = np.where(depth > 0, depth, np.nan)
        x, y = right / depth, down / depth
        if self.distortion:
            far_x, far_y = (
                np.abs(f * v + m - n / 2) > (0.5 + BEYOND) * n * scale
                for f, v, m, n, scale in (
                    (c.fx, x, c.cx, c.width, 1),
                    (c.fy, y, c.cy, c.height, 1),
                )
            )
            x, y = self.distortion.apply(*(np.where(far_x | far_y, np.nan, v) for v in (x, y)))
        return np.stack([c.fx * x + c.cx, c.fy * y + c.cy], axis=1)

    def reduced(self, image: np.ndarray) -> np.ndarray:
        """The part of an image of the photograph's size, (H, W) or (H, W, C), reduced to this."""
        x0, y0, x1, y1 = self.place
        size = self.camera.width, self.camera.height
        return cv2.resize(image[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)

    def inside(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """((M,) indices of the positions that lie in the image, their rows, their columns)."""
        x, y = np.floor(np.nan_to_num(self.pixels(positions), nan=-1)).T
        found = np.flatnonzero(
            (x >= 0) & (y >= 0) & (x < self.camera.width) & (y < self.camera.height)
        )
        return found, y[found].astype(int), x[found].astype(int)


def window(image: np.ndarray, photograph: Photograph, box: np.ndarray) -> Window:
    """The Window of a photograph, (H, W, 3) uint8. Raises UserError where it does not show the box
    (2, 3).
    """
    camera = photograph.camera
    whole = Window(photograph.name, image, camera, photograph.distortion, (0, 0, 0, 0))
    x, y = whole.pixels(corners_of(box)).T
    if np.isnan(x).any():  # the box is around the camera, or ends far outside the image
        x, y = np.array([0, camera.width]), np.array([0, camera.height])
    x0, x1 = _grown(x, camera.width)
    y0, y1 = _grown(y, camera.height)
    if x1 - x0 < 2 or y1 - y0 < 2:
        raise UserError(f"{photograph.name}: the object's box is outside; give another with --box")
    scale = min(1, CUT_SIDE / max(x1 - x0, y1 - y0))
    width, height = (max(2, round(scale * n)) for n in (x1 - x0, y1 - y0))
    sx, sy = width / (x1 - x0), height / (y1 - y0)
    camera = camera.crop(x0, y0, width, height)
    camera = replace(
        camera, fx=sx * camera.fx, fy=sy * camera.fy, cx=sx * camera.cx, cy=sy * camera.cy
    )
    found = replace(whole, camera=camera, place=(x0, y0, x1, y1))
    return replace(found, image=found.reduced(image))


def _grown(places, size):
    """(first, last + 1) pixel of the places, grown by AROUND, within an image's side."""
    margin = AROUND * np.ptp(places)
    return max(0, int(places.min() - margin)), min(size, int(places.max() + margin) + 1)


def cut_out_all(
    windows: Sequence[Window],
    box: np.ndarray,
    points: np.ndarray,
    inside: np.ndarray,
    seen: Sequence[np.ndarray],
) -> None:
    """Set the masks of the windows that have none.

    box, points, seen: as write_masks() takes them. inside: (N,) bool, the points in the box.
    """
    cv2.setNumThreads(1)
    left = [i for i, one in enumerate(windows) if one.mask is None]
    seeds = {i: _seeds(windows[i], box, points, inside, seen[i]) for i in left}
    labels = [
        seeds[i] if i in seeds else one.mask.astype(np.uint8) for i, one in enumerate(windows)
    ]

    for number in range(1 + ROUNDS):
        if number:
            hull = _hull(windows, box)
            for i in left:
                labels[i] = _relabelled(windows[i], seeds[i], *hull)
        colours = _colours(windows, labels)
        for i in tqdm(left, "cutting out", unit="image", leave=False, disable=None):
            windows[i].mask = _grab_cut(windows[i], labels[i], colours)
    for i in left:
        windows[i].mask = without_islands(windows[i].mask)


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
    near = _dots(one, one.pixels(points[inside & (points[:, 2] > foot)]), radius)
    near = _closed(near, round(NEAR * CUT_SIDE))
    labels[near & (labels == cv2.GC_PR_BGD)] = cv2.GC_PR_FGD
    shown_inside = inside[seen]
    sure = seen[shown_inside & (points[seen, 2] > foot)]
    labels[_dots(one, one.pixels(points[seen[~shown_inside]]), radius)] = cv2.GC_BGD
    labels[_dots(one, one.pixels(points[sure]), radius)] = cv2.GC_FGD
    return labels


def _dots(one, places, radius):
    """(H, W) bool: discs around places (N, 2) in pixels."""
    marked = np.zeros(one.image.shape[:2], np.uint8)
    x, y = np.floor(np.nan_to_num(places, nan=-1)).astype(int).T
    found = (x >= 0) & (y >= 0) & (x < marked.shape[1]) & (y < marked.shape[0])
    marked[y[found], x[found]] = 1
    return _dilated(marked, radius)


def _dilated(marked, radius):
    return cv2.dilate(marked.astype(np.uint8), _disc(radius)) > 0


def _eroded(marked, radius):
    return cv2.erode(marked.astype(np.uint8), _disc(radius)) > 0


def _disc(radius):
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _closed(marked, radius):
    """(H, W) bool with gaps narrower than two radii closed; nothing is beyond the border."""
    padded = np.pad(marked.astype(np.uint8), radius)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(radius))
    return closed[radius:-radius, radius:-radius] > 0


def _colours(
    windows: Sequence[Window], labels: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """(the background's, the object's) colours, (1, 65) float64 each: GrabCut's mixture of five
    normal distributions, fitted to SAMPLES^2 pixels of all windows.
    """
    rng, drawn = np.random.default_rng(0), []
    each = -(-(SAMPLES**2) // len(windows))
    for wanted in (0, 1):  # the lowest bit of a label says whether it is the object's
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


def _hull(windows: Sequence[Window], box: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """((N, 3) positions in the box that no more than FORGIVEN of the masks reject of the windows
    that see them, (N,) how many do, the positions' spacing).
    """
    grid = Grid.centred_in(box, smallest_edge(box, CELLS))
    positions = grid.positions(np.arange(np.prod(grid.dims)))
    seen, rejected = np.zeros((2, len(positions)), np.int32)
    most, left = int(FORGIVEN * len(windows)), np.arange(len(positions))
    for one in windows:
        found, rows, columns = one.inside(positions[left])
        seen[left[found]] += 1
        rejected[left[found]] += ~one.mask[rows, columns]
        left = left[rejected[left] <= most]
    seen, rejected = seen[left], rejected[left]
    kept = (seen >= min(LEAST_SEEING, len(windows))) & (rejected <= FORGIVEN * seen)
    if not kept.any():
        raise UserError(
            "the photographs have no part of the box in common that stands out from what is behind"
            " it; give masks with --masks, or another box with --box"
        )
    return positions[left[kept]], rejected[kept], grid.edge


def _relabelled(one, seeds, hull, rejections, edge):
    """(H, W) uint8 of GrabCut's labels of a window from what all views agree on: what is well
    outside the hull is background, what is well within what no other view rejects is the object.
    """
    middle = np.linalg.norm(hull.mean(0) - one.camera.eye)
    gap = max(1, int(np.ceil(edge * one.camera.fx / middle)))  # pixels between vertices
    found, rows, columns = one.inside(hull)
    held, core = np.zeros((2, *seeds.shape), bool)
    held[rows, columns] = True
    agreed = rejections[found] == ~one.mask[rows, columns]
    core[rows[agreed], columns[agreed]] = True
    held, core = _closed(held, gap), _closed(core, gap)
    labels = np.where(held & one.mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[_eroded(held, gap) & (seeds == cv2.GC_FGD)] = cv2.GC_FGD
    labels[seeds == cv2.GC_BGD] = cv2.GC_BGD
    labels[~_dilated(held, 2 * gap)] = cv2.GC_BGD
    labels[_eroded(core, 2 * gap + 1)] = cv2.GC_FGD
    return labels


def whole_mask(one: Window, photograph: np.ndarray) -> np.ndarray:
    """(H, W) uint8 mask of the whole photograph (H, W, 3): the window's, whose border follows the
    photograph's edges (guided filter, He et al. 2010) and is soft where they are.
    """
    x0, y0, x1, y1 = one.place
    guide = cv2.cvtColor(photograph[y0:y1, x0:x1], cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    rough = cv2.resize(one.mask.astype(np.float32), (x1 - x0, y1 - y0))
    side = 2 * max(1, round(SOFT * (x1 - x0) / one.mask.shape[1])) + 1

    def mean(values):
        return cv2.blur(values, (side, side), borderType=cv2.BORDER_REFLECT)

    means = mean(guide), mean(rough)
    variance = mean(guide * guide) - means[0] ** 2
    slope = (mean(guide * rough) - means[0] * means[1]) / (variance + FLAT)
    refined = mean(slope) * guide + mean(means[1] - slope * means[0])
    mask = np.zeros(photograph.shape[:2], np.uint8)
    mask[y0:y1, x0:x1] = np.clip(255 * refined + 0.5, 0, 255)
    return mask
