"""The visual hull: the grid vertices inside all training masks, where the points start."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.scene.agreement import explain_empty_hull
from pp_cl.scene.bounds import bounding_box, reach_of
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid, smallest_edge
from pp_cl.scene.views import MASK_THRESHOLD, View

# PlenopticPoints supplemental, Table 4: all grids stay below it, one of them short of points
CELL_CAP = 2**27
COARSE_CELLS = 2**21  # of the first carving, which only finds the object: about 128^3
ROUNDS = 8  # carvings after the coarse one
AIM = 1.01  # times the points asked for; Table 4: most scenes have 1.01 times 4 million points
TOLERANCE = 1.02  # a count of 1 to this many times the points asked for ends the search
# half-diagonals of the hull from its centre to near and to far: about the published range of 4 for
# lego
DEPTH_MARGIN = 1.25
VERTEX_WORK = 10  # multiply-adds that project a vertex into a view, and find its pixel
CORNER_BITS = 16  # the corner that carving counts from: whole 2^-16 of the size of the eyes' box


@dataclass(frozen=True)
class Hull:
    """Vertices inside the visual hull.

    grid: the smallest Grid that holds them. ids: (N,) uint32, ascending. capped: there are fewer
    points than asked for, because a finer grid would have more cells than the cap.
    """

    grid: Grid
    ids: np.ndarray
    capped: bool


@dataclass(frozen=True)
class Carving:
    """The vertices of a grid that lie inside the hull.

    bits: (rows, words) uint32 on the device, a set of vertices. extents: (rows, 3) uint32, count,
    first and last of each row of the grid (cl/scene/hull.cl:row_extents).
    """

    grid: Grid
    bits: Array
    extents: np.ndarray

    @property
    def count(self) -> int:
        """Number of vertices inside."""
        return int(self.extents[:, 0].sum(dtype=np.int64))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """((3,), (3,)): smallest and largest vertex coordinates (i, j, k) inside."""
        rows = np.flatnonzero(self.extents[:, 0])
        j, k = rows % self.grid.dims[1], rows // self.grid.dims[1]
        _, first, last = self.extents[rows].T.astype(np.int64)
        return np.array([first.min(), j.min(), k.min()]), np.array([last.max(), j.max(), k.max()])

    def box(self) -> np.ndarray:
        """(2, 3) box around the vertices inside, grown by one edge: the next carving searches
        there.
        """
        low, high = self.bounds()
        return np.asarray(self.grid.origin) + self.grid.edge * np.stack([low - 1, high + 1])


class Carver:
    """Masks and cameras of the stored images, on the device, to carve any grid with."""

    def __init__(self, dev: Device, views: Sequence[View]):
        self.dev = dev
        self.program = dev.program("scene/hull")
        self.cameras = [view.stored_camera for view in views]
        words = [-(-c.width // 32) for c in self.cameras]
        starts = np.cumsum([0, *(c.height * w for c, w in zip(self.cameras, words, strict=True))])
        self.masks = dev.empty((int(starts[-1]),), np.uint32)
        table = [
            (c.width, c.height, w, start)
            for c, w, start in zip(self.cameras, words, starts[:-1], strict=True)
        ]
        for view, (width, height, row_words, start) in zip(views, table, strict=True):
            self.program.launch(
                "pack_mask",
                (row_words, height),
                width=width,
                height=height,
                words=row_words,
                first=start,
                threshold=MASK_THRESHOLD,
                alpha=dev.upload(view.image[..., 3]),
                masks=self.masks,
            )
        self.view_masks = dev.upload(table, np.uint32)

    def carve(self, grid: Grid) -> Carving:
        """The vertices of a grid that some image sees and no mask rejects."""
        nx, ny, nz = grid.dims
        rows, words = ny * nz, -(-nx // 32)
        projections = self.dev.upload(
            [grid.projection(camera) for camera in self.cameras], np.float32
        )
        bits = self.dev.empty((rows, words), np.uint32)
        extents = self.dev.empty((rows, 3), np.uint32)
        self.program.launch(
            "carve",
            (words, rows),
            multiply_adds=VERTEX_WORK * 32 * words * rows * len(self.cameras),
            along=1,
            nx=nx,
            ny=ny,
            rows=rows,
            words=words,
            views=len(self.cameras),
            projections=projections,
            view_masks=self.view_masks,
            masks=self.masks,
            bits=bits,
        )
        self.program.launch("row_extents", rows, rows=rows, words=words, bits=bits, extents=extents)
        return Carving(grid, bits, extents.get())

    def points(self, carving: Carving) -> tuple[Grid, np.ndarray]:
        """(Grid, (N,) uint32 ascending ids): the smallest grid around the vertices inside, and
        their ids there.
        """
        low, high = carving.bounds()
        nx, ny, nz = (int(n) for n in high - low + 1)
        counts = carving.extents[:, 0]
        rows = len(counts)
        j, k = np.arange(rows) % carving.grid.dims[1], np.arange(rows) // carving.grid.dims[1]
        bases = nx * (j - low[1] + ny * (k - low[2])) - low[0]  # wraps below 0; the ids do not
        ids = self.dev.empty((carving.count,), np.uint32)
        self.program.launch(
            "expand_rows",
            rows,
            rows=rows,
            words=carving.bits.shape[1],
            bits=carving.bits,
            ids=ids,
            row_starts=self.dev.upload(np.cumsum(counts) - counts, np.uint32),
            row_bases=self.dev.upload(bases.astype(np.uint32)),
        )
        origin = np.asarray(carving.grid.origin) + carving.grid.edge * low
        return Grid(tuple(float(x) for x in origin), carving.grid.edge, (nx, ny, nz)), ids.get()


def build_grid(
    dev: Device, views: Sequence[View], points: int, box: np.ndarray | None = None
) -> Hull:
    """Hull with about `points` vertices: the rule that fits Table 4 of the PlenopticPoints
    supplemental.

    views: of any sizes; their stored images and cameras are used. box: (2, 3), which holds all
    vertices; None: what the masks allow, and where no view has one what all cameras see. A vertex
    is inside if some image sees it and each one that does has an alpha above MASK_THRESHOLD in the
    3x3 pixels around it.
    The search starts from the box that the masks allow and rescales the edge from the measured
    count, until the count is `points` to 1.02 points. At CELL_CAP vertices of the grid, or after
    8 rounds, the best carving is taken: the smallest with enough points, else the largest. Raises
    UserError for an impossible `points`, a view without a mask where others have one, masks or
    poses that leave no vertex, cameras that make no scene.
    """
    if not 1 <= points <= CELL_CAP:
        raise UserError(f"--points {points}: must be between 1 and {CELL_CAP}")
    masked = [view.has_mask for view in views]
    if any(masked) and not all(masked):
        raise UserError(
            f"{views[masked.index(False)].name}: has no transparent pixel, but other photographs"
            " have: give it a mask that is 0 around the object"
        )
    corner = _corner(views, reach_of(views))
    near = [view.moved(-corner) for view in views]
    limit = None if box is None else box - corner
    hull = _search(dev, near, points, bounding_box(near) if box is None else limit, limit)
    return replace(hull, grid=hull.grid.moved(corner))


def _corner(views, reach):
    """(3,) world position near the cameras, from which a scene far from the origin is carved as one
    at the origin is: views that are moved alike, by whole units of the corner, give the same hull.
    """
    eyes = np.stack([view.camera.eye for view in views])
    unit = 2.0 ** (math.frexp(reach)[1] - CORNER_BITS)
    return unit * np.floor(eyes.min(0) / unit)


def _search(dev, views, points, box, limit):
    """The Hull of build_grid() in a box. limit: (2, 3) that it may not leave, or None."""
    carver = Carver(dev, _farthest_point_order(views, box.mean(0)))

    def carve(edge):
        return carver.carve(Grid.centred_in(box, edge).rounded())

    best = last = carve(smallest_edge(box, min(COARSE_CELLS, CELL_CAP)))
    capped, rounds = False, 0
    if not last.count:
        raise UserError(explain_empty_hull(views, box))
    while rounds < ROUNDS and not points <= last.count <= TOLERANCE * points:
        box = last.box() if last.count else box
        if limit is not None:
            box = np.stack([np.maximum(box[0], limit[0]), np.minimum(box[1], limit[1])])
        wanted = last.grid.edge * (max(last.count, 0.5) / (AIM * points)) ** (1 / 3)
        edge = max(wanted, smallest_edge(box, CELL_CAP))
        capped = edge > wanted
        if capped and edge > 0.99 * last.grid.edge:
            break  # the box shrinks no more
        last = carve(edge)
        rounds += 1
        best = min(best, last, key=lambda c: (c.count < points, abs(c.count - points)))
    return Hull(*carver.points(best), capped and best.count < points)


def depth_range(views: Sequence[View], hull: Hull) -> tuple[float, float]:
    """(near, far) for all views, as Euclidean distances in world units (docs/scenes.md).

    The ball around the hull, DEPTH_MARGIN times enlarged, lies between them for every view. Where a
    camera is closer than that, near is half its distance from the hull's box, and inside the box
    one grid edge. A range stated by the dataset is kept, but widened to the ball itself, since
    points outside of it would be missing.
    """
    stated = [view.depth_range for view in views if view.depth_range]
    grid = hull.grid
    half = grid.edge * np.asarray(grid.dims) / 2  # of the box of the vertices' cells
    offsets = np.stack([view.camera.eye for view in views]) - grid.centre
    from_centre = np.linalg.norm(offsets, axis=1)
    from_box = np.linalg.norm(np.maximum(np.abs(offsets) - half, 0), axis=1)
    radius = (1 if stated else DEPTH_MARGIN) * np.linalg.norm(half)
    near = max(from_centre.min() - radius, from_box.min() / 2, grid.edge)
    far = from_centre.max() + radius
    return (
        float(min([near, *(view_near for view_near, _ in stated)])),
        float(max([far, *(view_far for _, view_far in stated)])),
    )


def spacing_pixels(grid: Grid, cameras: Sequence[Camera]) -> float:
    """Grid edge in pixels of the cameras' images, at the middle of the grid, mean over the
    cameras.
    """
    distances = [np.linalg.norm(camera.eye - grid.centre) for camera in cameras]
    pixels = [c.fx * grid.edge / d for c, d in zip(cameras, distances, strict=True)]
    return float(np.mean(pixels))


def _farthest_point_order(views, centre):
    """The views in farthest-point order of their directions from the centre: the first few already
    see the object from all sides, so that carving soon rejects most vertices.
    """
    directions = np.stack([view.camera.eye - centre for view in views])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    order, nearest = [], np.full(len(views), np.inf)
    for _ in views:
        order.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(directions - directions[order[-1]], axis=1))
        nearest[order[-1]] = -1
    return [views[i] for i in order]
