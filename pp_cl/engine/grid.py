"""The regular grid on whose vertices the points lie, and its refinement to half the spacing."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pp_cl.engine.camera import Camera

FLOAT32_BITS = 24
MOST_IDS = 2**32  # an id has 32 bits
BRICK = 8  # vertices along each side of a brick, a power of two, as in cl/grid.h
# steps (x, y, z) to 13 of a vertex's 26 neighbours; the others are their opposites
HALF_OF_NEIGHBOURS = [step for step in product((0, 1, -1), repeat=3) if step[::-1] > (0, 0, 0)]


@dataclass(frozen=True)
class Grid:
    """A regular grid.

    origin: world position of vertex (0, 0, 0). voxel_size: distance of neighbouring vertices, world
    units. dims: number of vertices along x, y and z.

    Ids number the vertices in bricks of 8x8x8; bricks, and vertices in a brick, are numbered x
    first. Points in the order of their ids are thus close to one another in all directions: 16
    consecutive ones cover few pixels and read data that is still in a cache. Incomplete bricks use
    up ids, too, so there are more ids than vertices.
    """

    origin: tuple[float, ...]
    voxel_size: float
    dims: tuple[int, ...]

    @classmethod
    def centred_in(cls, box: np.ndarray, voxel_size: float) -> "Grid":
        """The largest grid of this voxel size that fits into a (2, 3) box, centred in it."""
        steps = np.maximum(box[1] - box[0], 0) // voxel_size
        origin = box.mean(0) - voxel_size * steps / 2
        return cls(tuple(float(x) for x in origin), voxel_size, tuple(int(n) + 1 for n in steps))

    @classmethod
    def of_header(cls, stored: dict[str, Any]) -> "Grid":
        """The grid that header() described."""
        origin = tuple(map(float, stored["origin"]))  # JSON may hold integers beyond 64 bits
        return cls(origin, float(stored["voxel_size"]), tuple(stored["dims"]))

    def header(self) -> dict[str, Any]:
        """JSON-able: {"origin", "voxel_size", "dims"}."""
        return {
            "origin": [float(x) for x in self.origin],
            "voxel_size": float(self.voxel_size),
            "dims": [int(n) for n in self.dims],
        }

    def refined(self) -> "Grid":
        """The grid of half the spacing with eight vertices around each vertex of this grid: vertex
        (i, j, k) is in the middle of (2 i, 2 j, 2 k) to (2 i + 1, 2 j + 1, 2 k + 1).
        """
        origin = tuple(x - self.voxel_size / 4 for x in self.origin)
        return Grid(origin, self.voxel_size / 2, tuple(2 * n for n in self.dims))

    def coarsened(self) -> "Grid":
        """The grid whose refined() returns this grid."""
        origin = tuple(x + self.voxel_size / 2 for x in self.origin)
        return Grid(origin, 2 * self.voxel_size, tuple(n // 2 for n in self.dims))

    def children(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(ascending ids in refined(), index in `ids` of the parent of each), both (8 N) uint32.
        Raises ValueError if refined() has more vertices than 32 bits can number.
        """
        refined, first = self.refined(), 2 * self.coordinates(ids)
        if refined.id_count > MOST_IDS:
            raise ValueError(f"a grid of {self.dims} vertices cannot be refined")
        corners = product((0, 1), repeat=3)
        child_ids = np.concatenate([refined.ids(first + corner) for corner in corners])
        order = np.argsort(child_ids)
        return child_ids[order].astype(np.uint32), (order % len(ids)).astype(np.uint32)

    @property
    def centre(self) -> np.ndarray:
        """(3,) float64 world position of the middle of the vertices."""
        return np.asarray(self.origin) + self.voxel_size * (np.asarray(self.dims) - 1) / 2

    @property
    def box(self) -> np.ndarray:
        """(2, 3) float64: the first and the last vertex."""
        low = np.asarray(self.origin)
        return np.stack([low, low + self.voxel_size * (np.asarray(self.dims) - 1)])

    @cached_property
    def diagonal(self) -> float:
        """Distance from the first to the last vertex, world units; the voxel size if there is only
        one vertex.
        """
        return float(np.linalg.norm(np.ptp(self.box, axis=0))) or self.voxel_size

    def moved(self, by: ArrayLike) -> "Grid":
        """The grid moved by (3,) world units."""
        return replace(self, origin=tuple(float(x) for x in np.add(self.origin, by)))

    def rounded(self) -> "Grid":
        """The grid with its voxel size rounded to float32 and its origin to multiples of the voxel
        size's last bit. float64 then holds each vertex and the centre exactly, up to 2^28 voxels
        from the world's origin, and moves by multiples of that bit are exact.
        """
        unit = 2.0 ** (math.frexp(self.voxel_size)[1] - FLOAT32_BITS)
        origin = tuple(float(x) for x in unit * np.rint(np.divide(self.origin, unit)))
        return replace(
            self, origin=origin, voxel_size=float(unit * np.rint(self.voxel_size / unit))
        )

    def packed(self, centre: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
        """(8,) float32, the layout of cl/grid.h. centre: as for Camera.packed()."""
        origin = np.subtract(self.origin, centre)
        return np.array([*origin, self.voxel_size, *self.dims, 0], np.float32)

    def positions(self, ids: ArrayLike) -> np.ndarray:
        """(N, 3) float64 world positions of the vertices with ids (N,)."""
        return np.asarray(self.origin) + self.voxel_size * self.coordinates(ids)

    def lattice(self) -> np.ndarray:
        """(nz ny nx, 3) float64: the world positions of all vertices, x first."""
        places = np.moveaxis(np.indices(self.dims[::-1]), 0, -1)[..., ::-1].reshape(-1, 3)
        return np.asarray(self.origin) + self.voxel_size * places

    @property
    def id_count(self) -> int:
        """Number of ids in all bricks, including unused ids; every id is below it."""
        return BRICK**3 * math.prod(self._bricks())

    def coordinates(self, ids: ArrayLike) -> np.ndarray:
        """(N, 3) int64 (i, j, k) of the vertices with ids (N,)."""
        nx, ny, _ = self._bricks()
        brick, vertex = np.divmod(np.asarray(ids, np.int64), BRICK**3)
        bricks = np.stack([brick % nx, brick // nx % ny, brick // (nx * ny)], -1)
        inside = np.stack([vertex % BRICK, vertex // BRICK % BRICK, vertex // BRICK**2], -1)
        return BRICK * bricks + inside

    def ids(self, coordinates: np.ndarray) -> np.ndarray:
        """(N,) int64 ids of the vertices (i, j, k), (N, 3) int64: the inverse of coordinates()."""
        nx, ny, _ = self._bricks()
        brick, vertex = np.divmod(coordinates, BRICK)
        return np.dot(brick, (1, nx, nx * ny)) * BRICK**3 + np.dot(vertex, (1, BRICK, BRICK**2))

    def ids_of(self, is_chosen: np.ndarray) -> np.ndarray:
        """(N,) uint32: ascending ids of the vertices that is_chosen, (nz, ny, nx) bool, marks."""
        coordinates = np.stack(np.nonzero(is_chosen)[::-1], -1)
        return np.sort(self.ids(coordinates).astype(np.uint32))

    def _bricks(self):
        """Number of bricks along x, y and z."""
        return [-(-n // BRICK) for n in self.dims]

    def in_large_parts(self, ids: np.ndarray, least: int) -> np.ndarray:
        """(N,) bool: True for vertices, given by ascending ids (N,), in a connected part (sides,
        diagonals) of at least `least` vertices, or in the largest part if all are smaller. Memory
        grows with the number of vertices, not with the box around them.
        """
        ids, place, found_pairs = np.asarray(ids, np.int64), self.coordinates(ids), []
        for step in HALF_OF_NEIGHBOURS:
            there = place + step
            inside = np.flatnonzero(((there >= 0) & (there < self.dims)).all(1))
            wanted = self.ids(there[inside])
            places = np.searchsorted(ids, wanted)
            places[places == len(ids)] = 0
            known = ids[places] == wanted
            found_pairs.append(np.stack([inside[known], places[known]]).astype(np.int32))
        vertex, neighbour = np.concatenate(found_pairs, 1)
        graph = coo_array((np.ones(len(vertex), bool), (vertex, neighbour)), (len(ids), len(ids)))
        part = connected_components(graph, directed=False)[1]
        size = np.bincount(part)
        return size[part] >= min(least, size.max())

    def projection(self, camera: Camera) -> np.ndarray:
        """(3, 4) float64 matrix from vertex (i, j, k, 1) to (u w, v w, w), where (u, v) is the
        camera's pixel and w the depth along its optical axis.
        """
        intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        offset = np.asarray(self.origin) - camera.eye
        return (
            intrinsics
            @ camera.pose[:, :3].T
            @ np.column_stack([self.voxel_size * np.eye(3), offset])
        )


def smallest_voxel_size(box: np.ndarray, cells: int) -> float:
    """Voxel size, within 0.1 %, of the finest grid over a (2, 3) box with at most `cells` vertices;
    1 if the box is a single point.
    """
    size = box[1] - box[0]
    if not size.any():
        return 1.0
    size = np.maximum(size, 1e-6 * size.max())  # a box may be flat
    voxel_size = (size.prod() / cells) ** (1 / 3)
    while (excess := np.prod(size // voxel_size + 1) / cells) > 1:
        voxel_size *= max(excess ** (1 / 3), 1.001)
    return float(voxel_size)
