"""The visual hull: the grid vertices inside all training masks, at which the points start."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from skimage.morphology import closing, dilation, disk

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid, smallest_voxel_size
from pp_cl.engine.views import MASK_THRESHOLD, View, border
from pp_cl.errors import UserError
from pp_cl.scene.agreement import Disagreement, disagreements, explain_empty_hull
from pp_cl.scene.bounds import bounding_box, reach_of
from pp_cl.scene.wrong_cameras import looking_away, wrong_cameras

# PlenopticPoints supplemental, Table 4: all grids stay below this, one with too few points
CELL_CAP = 2**27
COARSE_CELLS = 2**21  # about 128^3, for the first carving, which only finds the object
ROUNDS = 8  # carvings after the coarse one
AIM = 1.01  # times the requested points; Table 4: most scenes have 1.01 times 4 million points
TOLERANCE = 1.02  # the search ends at 1 to this many times the requested points
# half-diagonals of the hull from its centre to near and to far: about the published range of 4 for
# lego
DEPTH_MARGIN = 1.25
LEAST_SEEING = 3  # images that must see a vertex: few images show the space behind the object
# A view is left out if more than this share of its mask, and several times the usual share, lies
# beside the hull: 0.05 to 0.13 if a mask is moved by 6 % of the image, at most 0.03 if it is right.
MOST_BESIDE, TIMES_USUAL = 0.05, 3.0
MOST_LEFT_OUT = 1 / 8  # of the views
# The share of a mask beside the hull measures its error: 0 for rendered masks, 0.0001 to 0.016 for
# masks of photographs. If the mean share exceeds MOST_MISSED, a vertex may stay although some masks
# reject it: as few masks as bring the mean below, but at most MOST_FORGIVEN of all. Training cannot
# restore a missing part of the hull, but it prunes superfluous points: mary_rose's sound views gain
# 1.4 dB if 12 of 60 masks may reject a vertex instead of 4.
MOST_MISSED, MOST_FORGIVEN = 0.0002, 1 / 4
# points of the hull, and pixels of the images, with which masks are compared
COMPARED_POINTS, COMPARED_SIZE = 60_000, 128
SAMPLED_POINTS = 1000
VERTEX_WORK = 10  # multiply-adds that project a vertex into a view and find its pixel
CORNER_BITS = 16  # carving's origin is a whole multiple of 2^-16 of the size of the eyes' box


@dataclass(frozen=True)
class Hull:
    """Vertices inside the visual hull. grid: the smallest Grid that holds them. ids: (N,) uint32,
    ascending. capped: the cap on the grid's cells left fewer points than requested.
    """

    grid: Grid
    ids: np.ndarray
    capped: bool = False


class Carver:
    """Masks and cameras of the stored images, on the device, which carve any grid. Masks are
    widened by a pixel, which keeps vertices that touch the silhouette, and by a pixel of the
    reduced image, since poses and masks are inexact. least: images that must see a vertex. doubts:
    1 if few masks end within their image. Then an image also takes one from the count of images
    that see a vertex outside it, if the nearest pixel of its border is beside the mask: so images
    cropped to the object bound it.
    """

    def __init__(self, dev: Device, views: Sequence[View]):
        self.dev = dev
        self.program = dev.program("scene/hull")
        self.cameras = [view.stored_camera for view in views]
        self.least = min(LEAST_SEEING, len(views)) if any(v.has_mask for v in views) else 1
        table, start = [], 0
        for camera in self.cameras:
            words = -(-camera.width // 32)
            table.append((camera.width, camera.height, words, start))
            start += words * camera.height
        self.masks = dev.empty((start,), np.uint32)
        for view, (_, height, words, first) in zip(views, table, strict=True):
            self._add_mask(view, height, words, first)
        self.view_masks = dev.upload(table, np.uint32)
        is_whole = [not (border(view.hull_alpha) > MASK_THRESHOLD).any() for view in views]
        self.view_is_whole = dev.upload(is_whole, np.uint32)
        # enough whole masks bound the object; close-ups must not take away vertices they do not
        # show
        self.doubts = int(sum(is_whole) < self.least)

    def _add_mask(self, view, height, words, first):
        """Write a view's widened mask, starting at word `first`."""
        mask, other = (self.dev.empty((height * words,), np.uint32) for _ in range(2))
        self.program.launch(
            "pack_mask",
            (words, height),
            width=view.image.shape[1],
            height=height,
            words=words,
            threshold=MASK_THRESHOLD,
            alpha=self.dev.upload(view.hull_alpha),
            mask=mask,
        )
        for further in range(view.downscale, -1, -1):
            self.program.launch(
                "widen_mask",
                (words, height),
                height=height,
                words=words,
                first=0 if further else first,
                mask=mask,
                masks=other if further else self.masks,
            )
            mask, other = other, mask

    def carve(self, grid: Grid, forgiven: int = 0) -> np.ndarray:
        """(nz, ny, nx) bool: the vertices of a grid that enough images see, and whose masks reject
        them in no larger share of these images than `forgiven` is of all.
        """
        nx, ny, nz = grid.dims
        rows, words = ny * nz, -(-nx // 32)
        projections = [grid.projection(camera) for camera in self.cameras]
        bits = self.dev.empty((rows, words), np.uint32)
        self.program.launch(
            "carve",
            (words, rows),
            multiply_adds=VERTEX_WORK * 32 * words * rows * len(self.cameras),
            along=1,
            ny=ny,
            rows=rows,
            words=words,
            views=len(self.cameras),
            least=self.least,
            doubts=self.doubts,
            forgiven=forgiven,
            projections=self.dev.upload(projections, np.float32),
            view_masks=self.view_masks,
            view_is_whole=self.view_is_whole,
            masks=self.masks,
            bits=bits,
        )
        packed = self.dev.download(bits).view(np.uint8)
        inside = np.unpackbits(packed, axis=1, count=nx, bitorder="little")
        return inside.view(bool).reshape(nz, ny, nx)


def build_grid(
    dev: Device,
    views: Sequence[View],
    points: int,
    box: np.ndarray | None = None,
    forgiven: int = 0,
) -> Hull:
    """Hull with about `points` vertices, by a rule that fits Table 4 of the PlenopticPoints
    supplemental. box: (2, 3) box that holds all vertices; None: the box that the masks allow, or
    without masks the box that all cameras see. forgiven: as in Agreement.

    The search starts from the box that the masks allow and rescales the voxel size from the
    measured count until that is between `points` and 1.02 `points`. At CELL_CAP vertices of the
    grid, or after 8 rounds, it takes the smallest carving with enough points, or else the largest.
    Raises UserError for an impossible `points`, for masks or poses that leave no vertex, and as
    reach_of() and bounding_box() do.
    """
    if not 1 <= points <= CELL_CAP:
        raise UserError(f"--points {points}: must be between 1 and {CELL_CAP}")
    corner = _corner(views, reach_of(views))
    near = [view.moved(-corner) for view in views]
    limit = None if box is None else box - corner
    box = _box(near, limit, forgiven)
    carver = Carver(dev, _farthest_point_order(near, box.mean(0)))

    def carve(voxel_size):
        grid = Grid.centred_in(box, voxel_size).rounded()
        return _tight(grid, carver.carve(grid, forgiven))

    best = last = carve(smallest_voxel_size(box, min(COARSE_CELLS, CELL_CAP)))
    capped, rounds, count = False, 0, last.total
    if not count:
        raise UserError(explain_empty_hull(near, box))
    while rounds < ROUNDS and not points <= count <= TOLERANCE * points:
        if count:  # the next carving searches one voxel further on each side
            box = last.grid.box + last.grid.voxel_size * np.array([[-1], [1]])
        if limit is not None:
            box = np.stack([np.maximum(box[0], limit[0]), np.minimum(box[1], limit[1])])
        wanted = last.grid.voxel_size * (max(count, 0.5) / (AIM * points)) ** (1 / 3)
        voxel_size = max(wanted, smallest_voxel_size(box, CELL_CAP))
        capped = voxel_size > wanted
        if capped and voxel_size > 0.99 * last.grid.voxel_size:
            break  # the box no longer shrinks
        last = carve(voxel_size)
        count, rounds = last.total, rounds + 1
        best = min(best, last, key=lambda c: (c.total < points, abs(c.total - points)))
    ids = best.grid.ids_of(best.inside)
    return Hull(best.grid.moved(corner), ids, capped and best.total < points)


def hull_on(dev: Device, views: Sequence[View], grid: Grid, forgiven: int = 0) -> np.ndarray:
    """(N,) ascending ids of a grid's vertices inside the hull that build_grid() finds."""
    corner = _corner(views, reach_of(views))
    near = [view.moved(-corner) for view in views]
    carver = Carver(dev, _farthest_point_order(near, grid.centre - corner))
    return grid.ids_of(carver.carve(grid.moved(-corner), forgiven))


def _box(views, given_box, forgiven):
    """The part of the given box within the bounding box of the masks, which is doubled if some
    masks are forgiven.
    """
    if given_box is not None and not any(view.has_mask for view in views):
        return given_box
    box = bounding_box(views)
    if forgiven:
        box = box.mean(0) + np.array([[-1], [1]]) * np.ptp(box, axis=0)
    if given_box is None:
        return box
    shared = np.stack([np.maximum(box[0], given_box[0]), np.minimum(box[1], given_box[1])])
    return shared if (shared[0] < shared[1]).all() else given_box


def _corner(views, reach):
    """(3,) world position near the cameras, in whole units, so that a scene moved by whole units
    gives the same hull.
    """
    eyes = np.stack([view.camera.eye for view in views])
    unit = 2.0 ** (math.frexp(reach)[1] - CORNER_BITS)
    return unit * np.floor(eyes.min(0) / unit)


class _Carving(NamedTuple):
    """The smallest grid that holds all `total` carved vertices. inside: (nz, ny, nx) bool."""

    grid: Grid
    inside: np.ndarray
    total: int


def _tight(grid, inside):
    """The _Carving of a grid's vertices inside, (nz, ny, nx) bool; the whole grid if none is."""
    used = [np.flatnonzero(inside.any(axis=axes)) for axes in ((0, 1), (0, 2), (1, 2))]
    if not len(used[0]):
        return _Carving(grid, inside, 0)
    low = np.array([places[0] for places in used])
    part = inside[tuple(slice(places[0], places[-1] + 1) for places in reversed(used))]
    origin = np.asarray(grid.origin) + grid.voxel_size * low
    tight = Grid(tuple(float(x) for x in origin), grid.voxel_size, part.shape[::-1])
    return _Carving(tight, part, int(np.count_nonzero(part)))


def depth_range(views: Sequence[View], hull: Hull) -> tuple[float, float]:
    """(near, far) for all views, as Euclidean distances in world units (docs/scenes.md): the range
    of the hull's ball, enlarged DEPTH_MARGIN times; near is at least one voxel and half the
    distance to the hull's box. If the dataset states ranges for most views, they are widened to
    contain the ball itself.
    """
    stated, grid = [view.depth_range for view in views if view.depth_range], hull.grid
    stated = stated if 2 * len(stated) > len(views) else []
    half = grid.voxel_size * np.asarray(grid.dims) / 2  # half the box of the vertices' cells
    offsets = np.stack([view.camera.eye for view in views]) - grid.centre
    from_centre = np.linalg.norm(offsets, axis=1)
    from_box = np.linalg.norm(np.maximum(np.abs(offsets) - half, 0), axis=1)
    radius = (1 if stated else DEPTH_MARGIN) * np.linalg.norm(half)
    near = max(from_centre.min() - radius, from_box.min() / 2, grid.voxel_size)
    ranges = np.array([(near, from_centre.max() + radius), *stated])
    return float(ranges[:, 0].min()), float(ranges[:, 1].max())


def spacing_pixels(grid: Grid, cameras: Sequence[Camera]) -> float:
    """Mean voxel size at the middle of the grid, in pixels of the cameras' images."""
    distances = [np.linalg.norm(camera.eye - grid.centre) for camera in cameras]
    pixels = [c.fx * grid.voxel_size / d for c, d in zip(cameras, distances, strict=True)]
    return float(np.mean(pixels))


def silhouette(grid: Grid, ids: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: the pixels that points with ids (N,) cover, with gaps between them closed."""
    # bounded for a camera among the points
    spacing = min(spacing_pixels(grid, [camera]), max(camera.width, camera.height) / 4)
    gap = math.ceil(spacing) + 1
    wide = camera.crop(-gap, -gap, camera.width + 2 * gap, camera.height + 2 * gap)
    column, row, is_shown = wide.pixels(grid.positions(ids))
    marked = np.zeros((wide.height, wide.width), bool)
    marked[row[is_shown], column[is_shown]] = True
    return closing(marked, disk(gap))[gap:-gap, gap:-gap]


class Agreement(NamedTuple):
    """views: the views whose masks agree. left_out: {name of another view: share of its mask beside
    the hull}. forgiven: how many of the masks may reject a vertex.
    """

    views: list[View]
    left_out: dict[str, float]
    forgiven: int


class Beside(NamedTuple):
    """The mean share of a mask that lies beside the hull. strictly: if no mask is forgiven, or 1 if
    that leaves no hull. forgiving: if MOST_FORGIVEN of them are, which helps against wrong masks
    but not against wrong cameras.
    """

    strictly: float
    forgiving: float


def agreeing(dev: Device, views: Sequence[View], box: np.ndarray | None = None) -> Agreement:
    """The Agreement that agreement_of() finds."""
    return agreement_of(dev, views, box)[0]


def agreement_of(
    dev: Device, views: Sequence[View], box: np.ndarray | None = None
) -> tuple[Agreement, Beside]:
    """How far masks agree, measured by the share of each mask beside the hull. Views are left out
    that are suspects(), or if that share exceeds MOST_BESIDE and several times the usual share. If
    all masks deviate a little, as many as necessary are forgiven. Raises UserError as build_grid()
    does.
    """
    if not any(view.has_mask for view in views):
        # with a box, views need not show one place
        kept, left_out = _without_suspects(views) if box is None else (list(views), {})
        return Agreement(kept, left_out, 0), Beside(0.0, 0.0)
    most = int(MOST_LEFT_OUT * len(views))
    kept, left_out = list(views), dict[str, float]()
    for is_sorted in (False, True):
        forgiven = most // 2
        try:
            shares = shares_beside(dev, kept, box, 0)
            beside = float(shares.mean())
            if shares.max() <= MOST_BESIDE / 2:
                return Agreement(kept, left_out, 0), Beside(beside, beside)
        except UserError:  # no place is in all masks
            beside, forgiven = 1.0, most
        if not is_sorted:
            kept, left_out = _without_suspects(views)
    while len(left_out) < most:
        shares = shares_beside(dev, kept, box, forgiven)
        worst = int(shares.argmax())
        if shares[worst] <= max(MOST_BESIDE, TIMES_USUAL * np.median(shares)):
            break
        left_out[kept.pop(worst).name] = float(shares[worst])
    # the more masks are forgiven, the smaller is their share beside the hull
    least = bisect_left(
        range(int(MOST_FORGIVEN * len(kept))),
        True,
        key=lambda forgiven: shares_beside(dev, kept, box, forgiven).mean() <= MOST_MISSED,
    )
    quarter = int(MOST_FORGIVEN * len(kept))
    forgiving = shares_beside(dev, kept, box, quarter).mean() if beside > MOST_BESIDE else beside
    return Agreement(kept, left_out, least), Beside(beside, float(forgiving))


def suspects(views: Sequence[View]) -> dict[int, float]:
    """The views whose cameras, or whole masks, contradict the others: {index: share of the mask
    beside the others' hull}.
    """
    if any(view.has_mask for view in views):
        return wrong_cameras(views)
    return dict.fromkeys(looking_away(views), 1.0)


def _without_suspects(views: Sequence[View]) -> tuple[list[View], dict[str, float]]:
    """(the other views, {name: share} of the suspects()), if these are not too many."""
    left_out = {views[i].name: share for i, share in suspects(views).items()}
    if len(left_out) > math.ceil(MOST_LEFT_OUT * len(views)):
        return list(views), {}
    return [view for view in views if view.name not in left_out], left_out


def contradicting(views: Sequence[View], hull: Hull, agreement: Agreement) -> list[Disagreement]:
    """disagreements() around a hull. If no mask has to be forgiven, only those of views left out:
    any other view that carves alone is the only one to show that the place is empty.
    """
    contradictions = disagreements(views, hull.grid.box)
    return [
        disagreement
        for disagreement in contradictions
        if agreement.forgiven or disagreement.view.name in agreement.left_out
    ]


def misplaced(grid: Grid, ids: np.ndarray, views: Sequence[View]) -> list[View]:
    """The views whose mask covers a much smaller share than usual of the points with ids (N,) that
    the view shows: their cameras or masks belong to another place.
    """
    places = grid.positions(ids[:: max(1, len(ids) // SAMPLED_POINTS)])
    masked, shares = [view for view in views if view.has_mask], []
    for view in masked:
        column, row, is_shown = view.stored_camera.pixels(places)
        is_on = view.hull_alpha[row, column] > MASK_THRESHOLD
        shares.append((is_on & is_shown).sum() / max(is_shown.sum(), 1))
    least = np.median(shares or [0]) / TIMES_USUAL
    return [view for view, share in zip(masked, shares, strict=True) if share < least]


def shares_beside(
    dev: Device,
    views: Sequence[View],
    box: np.ndarray | None,
    forgiven: int,
    points: int = COMPARED_POINTS,
) -> np.ndarray:
    """(V,) the share of each view's mask that is more than a pixel outside the silhouette of the
    views' hull with `points` points. Raises UserError as build_grid() does.
    """
    hull = build_grid(dev, views, min(points, CELL_CAP), box, forgiven)
    shares = []
    for view in views:
        small = view.near_size(COMPARED_SIZE)
        camera, k = small.camera, small.downscale
        mask = view.image[: camera.height * k : k, : camera.width * k : k, 3] > 127
        covered = dilation(silhouette(hull.grid, hull.ids, camera), disk(1))
        shares.append((mask & ~covered).sum() / max(mask.sum(), 1))
    return np.array(shares)


def _farthest_point_order(views, centre):
    """The views in farthest-point order of their directions, so that the first few reject most
    vertices.
    """
    directions = np.stack([view.camera.eye - centre for view in views])
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    directions /= np.where(lengths > 0, lengths, 1)  # an eye may be at the centre
    order, nearest = [], np.full(len(views), np.inf)
    for _ in views:
        order.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(directions - directions[order[-1]], axis=1))
        nearest[order[-1]] = -1
    return [views[i] for i in order]
