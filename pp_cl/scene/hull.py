"""The initial points: vertices of a regular grid inside the visual hull of the training masks."""

import time
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from pp_cl.errors import UserError
from pp_cl.scene.grid import Grid
from pp_cl.scene.views import MASK_THRESHOLD

# PlenopticPoints supplemental, Table 4: all grids stay below it, one of them short of points
CELL_CAP = 2**27
COARSE_CELLS = 2**21  # of the first carve, which only finds the object: about 128^3
ROUNDS = 8  # carves after the coarse one
AIM = 1.01  # times the points asked for; Table 4: most scenes have 1.01 times 4 million points
TOLERANCE = 1.02  # a count of 1 to this many times the points asked for ends the search
# how far, in image sizes, an object that the image border cuts off may reach beyond the border
CROPPED_MARGIN = 0.5
# half-diagonals of the hull from its centre to near and to far: about the published range of 4 for
# lego
DEPTH_MARGIN = 1.25
NAMES_SHOWN = 3  # views named in an error
SOLVED, INFEASIBLE = 0, 2  # status of scipy.optimize.linprog


@dataclass(frozen=True)
class Hull:
    """Vertices inside the visual hull.

    grid: their tight Grid; ids: (N,) uint32, ascending; capped: the cell cap left fewer points than
    asked for; rounds: {"edge", "dims", "points", "seconds"} of each carve, the coarse one first.
    """

    grid: Grid
    ids: np.ndarray
    capped: bool
    rounds: list


@dataclass(frozen=True)
class Carving:
    """Which vertices of a grid are kept. bits: (rows, words) on the device; extents: (rows, 3) of
    cl/scene/hull.cl:row_extents.
    """

    grid: Grid
    bits: object
    extents: np.ndarray

    @property
    def count(self):
        """Vertices kept."""
        return int(self.extents[:, 0].sum(dtype=np.int64))

    def bounds(self):
        """((3,), (3,)): the smallest and largest vertex coordinates (i, j, k) kept."""
        rows = np.flatnonzero(self.extents[:, 0])
        j, k = rows % self.grid.dims[1], rows // self.grid.dims[1]
        _, first, last = self.extents[rows].T.astype(np.int64)
        return np.array([first.min(), j.min(), k.min()]), np.array([last.max(), j.max(), k.max()])

    def box(self):
        """(2, 3) the box of the vertices kept, grown by one edge: what the next round searches."""
        low, high = self.bounds()
        return np.asarray(self.grid.origin) + self.grid.edge * np.stack([low - 1, high + 1])


class Carver:
    """Masks and cameras of the views on the device, ready to carve any grid."""

    def __init__(self, dev, views):
        self.dev = dev
        self.program = dev.program("scene/hull")
        self.cameras = [view.camera for view in views]
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

    def carve(self, grid):
        """Carving of a Grid."""
        nx, ny, nz = grid.dims
        rows, words = ny * nz, -(-nx // 32)
        projections = self.dev.upload(
            [_projection(camera, grid) for camera in self.cameras], np.float32
        )
        bits = self.dev.empty((rows, words), np.uint32)
        extents = self.dev.empty((rows, 3), np.uint32)
        self.program.launch(
            "carve",
            (words, rows),
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

    def points(self, carving):
        """(Grid, (N,) uint32 ascending ids): the tight grid of a carving, and its vertices
        there.
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


def build_grid(dev, views, points, cell_cap=CELL_CAP):
    """Hull with about `points` vertices: the rule that fits Table 4 of the PlenopticPoints
    supplemental.

    views: scene.View, of any sizes. A vertex is kept iff some image sees it and each one that does
    has an alpha above MASK_THRESHOLD in the 3x3 pixels around it. The search starts from the box
    that the masks allow and rescales the edge from the measured count, until the count is `points`
    to 1.02 points. At the cell cap, or after 8 rounds, the best carve stands: the smallest of those
    with enough points, else the largest. Raises UserError for an impossible `points`, a view
    without a mask, masks or poses that leave no vertex.
    """
    if not 1 <= points <= cell_cap:
        raise UserError(f"--points {points}: must be between 1 and {cell_cap}")
    for view in views:
        if view.image[..., 3].min() == 255:
            raise UserError(
                f"{view.name}: has no transparent pixel, but the points start from masks: "
                "give it an alpha channel that is 0 around the object"
            )
    box, start = bounding_box(views), time.perf_counter()
    carver = Carver(dev, _sides_first(views, box.mean(0)))
    best = last = carver.carve(_grid_over(box, _smallest_edge(box, min(COARSE_CELLS, cell_cap))))
    rounds, capped = [_log(last, start)], False
    if not last.count:
        raise UserError(_blame(views, box))
    while len(rounds) <= ROUNDS and not points <= last.count <= TOLERANCE * points:
        box = last.box() if last.count else box
        wanted = last.grid.edge * (max(last.count, 0.5) / (AIM * points)) ** (1 / 3)
        edge = max(wanted, _smallest_edge(box, cell_cap))
        capped = edge > wanted
        if capped and edge > 0.99 * last.grid.edge:
            break  # the box shrinks no more
        start = time.perf_counter()
        last = carver.carve(_grid_over(box, edge))
        rounds.append(_log(last, start))
        best = min(best, last, key=lambda c: (c.count < points, abs(c.count - points)))
    return Hull(*carver.points(best), capped and best.count < points, rounds)


def depth_range(views, hull):
    """(near, far) of all views, as Euclidean distances in world units (docs/scene_scale.md).

    The ball around the hull, DEPTH_MARGIN times enlarged, lies between them for every view. Where a
    camera is closer than that, near is half its distance from the hull's box, and inside the box
    one grid edge. A stated range is kept, but widened to the ball itself, since points outside of
    it would be missing.
    """
    stated = all(view.has_depth_range for view in views)
    half = hull.grid.edge * np.asarray(hull.grid.dims) / 2  # of the box of the vertices' cells
    offsets = np.stack([view.camera.eye for view in views]) - _centre(hull.grid)
    from_centre = np.linalg.norm(offsets, axis=1)
    from_box = np.linalg.norm(np.maximum(np.abs(offsets) - half, 0), axis=1)
    radius = (1 if stated else DEPTH_MARGIN) * np.linalg.norm(half)
    near, far = (
        max(from_centre.min() - radius, from_box.min() / 2, hull.grid.edge),
        from_centre.max() + radius,
    )
    if stated:
        near, far = (
            min(near, *(view.camera.near for view in views)),
            max(far, *(view.camera.far for view in views)),
        )
    return float(near), float(far)


def spacing_pixels(hull, views, downscale=1):
    """Grid edge in pixels of the views' images reduced `downscale` times, at the hull's centre,
    mean over the views.
    """
    centre = _centre(hull.grid)
    return float(
        np.mean(
            [
                v.camera.fx / downscale * hull.grid.edge / np.linalg.norm(v.camera.eye - centre)
                for v in views
            ]
        )
    )


def _centre(grid):
    return np.asarray(grid.origin) + grid.edge * (np.asarray(grid.dims) - 1) / 2


def bounding_box(views):
    """(2, 3) box around what the masks' rectangles allow: the intersection of one pyramid per view,
    by linear programs.

    A side where the mask reaches the image border does not bound the object, unless nothing else
    does; then the object is taken to end CROPPED_MARGIN image sizes outside. Raises UserError when
    the pyramids do not meet or do not end.
    """
    for margin in (None, CROPPED_MARGIN):
        planes = np.concatenate([_silhouette_planes(view, margin) for view in views])
        # lower bounds of x, y, z, -x, -y, -z
        bounds = [
            linprog(axis, -planes[:, :3], -planes[:, 3], bounds=(None, None))
            for axis in (*np.eye(3), *-np.eye(3))
        ]
        if any(b.status == INFEASIBLE for b in bounds):
            eyes = np.stack([view.camera.eye for view in views])
            reach = np.ptp(eyes, axis=0).max() or 1.0
            raise UserError(_blame(views, eyes.mean(0) + reach * np.array([[-1], [1]])))
        if all(b.status == SOLVED for b in bounds):
            return np.array([[1], [-1]]) * np.array([b.fun for b in bounds]).reshape(2, 3)
    raise UserError(
        f"{views[0].name} and the {len(views) - 1} other training views do not bound the object: "
        "it must be seen from several sides"
    )


def _silhouette_planes(view, cropped_margin):
    """(P, 4) normals n and offsets o: n.x >= o holds for all x that the rectangle around the
    dilated mask lets pass.

    Sides where it reaches the image border: left out, or cropped_margin image sizes further out.
    """
    camera, mask = view.camera, view.image[..., 3] > MASK_THRESHOLD
    normals = []
    for axis, size, focal, centre in (
        (0, camera.width, camera.fx, camera.cx),
        (1, camera.height, camera.fy, camera.cy),
    ):
        used = np.flatnonzero(mask.any(axis))
        if not used.size:
            continue
        for sign, edge, border in ((1, used[0] - 1, 0), (-1, used[-1] + 2, size)):
            if sign * (edge - border) <= 0:
                if cropped_margin is None:
                    continue
                edge = border - sign * cropped_margin * size
            normal = np.array([0, 0, -(edge - centre) / focal])
            normal[axis] = 1
            normals.append(sign * camera.pose[:, :3] @ normal / np.linalg.norm(normal))
    normals = np.array(normals).reshape(-1, 3)
    return np.column_stack([normals, normals @ camera.eye])


def _sides_first(views, centre):
    """The views in farthest-point order of their directions: the first few already see the object
    from all sides.
    """
    directions = np.stack([view.camera.eye - centre for view in views])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    order, nearest = [], np.full(len(views), np.inf)
    for _ in views:
        order.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(directions - directions[order[-1]], axis=1))
        nearest[order[-1]] = -1
    return [views[i] for i in order]


def _smallest_edge(box, cells):
    """Edge, within 0.1 %, of the finest grid over a box that has no more than `cells` vertices."""
    size = np.maximum(box[1] - box[0], 1e-6 * np.ptp(box))  # a box may be flat
    edge = (size.prod() / cells) ** (1 / 3)
    while (excess := np.prod(size // edge + 1) / cells) > 1:
        edge *= max(excess ** (1 / 3), 1.001)
    return float(edge)


def _grid_over(box, edge):
    """The grid of an edge that lies centred in a box."""
    steps = np.maximum(box[1] - box[0], 0) // edge
    origin = box.mean(0) - edge * steps / 2
    return Grid(tuple(float(x) for x in origin), edge, tuple(int(n) + 1 for n in steps))


def _projection(camera, grid):
    """(3, 4) float64: grid vertex (i, j, k, 1) -> (u w, v w, w), with pixel (u, v) and depth w
    along the optical axis.
    """
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    offset = np.asarray(grid.origin) - camera.eye
    return intrinsics @ camera.pose[:, :3].T @ np.column_stack([grid.edge * np.eye(3), offset])


def _log(carving, start):
    seconds = time.perf_counter() - start
    return {
        "edge": carving.grid.edge,
        "dims": carving.grid.dims,
        "points": carving.count,
        "seconds": seconds,
    }


def _blame(views, box):
    """One line on why nothing is left: which views reject what most others keep, of about 32^3
    places in a box.
    """
    empty = [view.name for view in views if view.image[..., 3].max() <= MASK_THRESHOLD]
    if empty:
        return (
            f"{_names(empty)}: the mask is empty (no alpha above {MASK_THRESHOLD}): mend or remove"
            " the image"
        )
    grid = _grid_over(box, _smallest_edge(box, 32**3))
    places = np.stack(np.meshgrid(*(np.arange(n) for n in grid.dims), [1]), -1).reshape(-1, 4)
    kept, rejected = np.stack(
        [_verdicts(view, _projection(view.camera, grid) @ places.T) for view in views], axis=1
    )
    agreeing = kept.sum(0).max()
    objections = rejected[:, kept.sum(0) == agreeing].mean(1)
    names = [views[i].name for i in np.argsort(-objections, kind="stable") if objections[i] > 0]
    if agreeing >= 0.75 * len(views) and names:
        return (
            f"{_names(names)}: the mask leaves nothing of what the other views agree on: check its"
            " alpha and its camera"
        )
    names = _names([view.name for view in views])
    return (
        f"{names}: the masks leave no point, at most {agreeing} of {len(views)} meet in one place:"
        " check the masks and the camera poses (camera-to-world; in transforms files x right, y"
        " up, z backward)"
    )


def _verdicts(view, projected):
    """(2, N) bool: the places (3, N) that fall onto the mask, and those that fall into the image
    beside it.
    """
    u, v, depth = projected
    ahead = depth > 0
    x, y = (np.floor(np.divide(a, depth, where=ahead, out=np.full_like(a, -1))) for a in (u, v))
    inside = ahead & (x >= 0) & (x < view.camera.width) & (y >= 0) & (y < view.camera.height)
    on = (
        view.image[np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int), 3]
        > MASK_THRESHOLD
    )
    return np.stack([inside & on, inside & ~on])


def _names(names):
    return ", ".join(names[:NAMES_SHOWN]) + (
        f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
    )
