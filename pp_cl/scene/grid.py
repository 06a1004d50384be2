"""The regular grid whose vertices are the points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pp_cl.scene.camera import Camera


@dataclass(frozen=True)
class Grid:
    """A regular grid.

    origin: world position of vertex (0, 0, 0). edge: spacing, world units. dims: number of vertices
    along x, y and z.
    """

    origin: tuple[float, float, float]
    edge: float
    dims: tuple[int, int, int]

    @classmethod
    def centred_in(cls, box: np.ndarray, edge: float) -> "Grid":
        """The largest grid of this edge that fits into a (2, 3) box, centred in it."""
        steps = np.maximum(box[1] - box[0], 0) // edge
        origin = box.mean(0) - edge * steps / 2
        return cls(tuple(float(x) for x in origin), edge, tuple(int(n) + 1 for n in steps))

    @property
    def centre(self) -> np.ndarray:
        """(3,) float64 world position of the middle of the vertices."""
        return np.asarray(self.origin) + self.edge * (np.asarray(self.dims) - 1) / 2

    def packed(self) -> np.ndarray:
        """(8,) float32, the layout of cl/grid.h."""
        return np.array([*self.origin, self.edge, *self.dims, 0], np.float32)

    def positions(self, ids: ArrayLike) -> np.ndarray:
        """(N, 3) float64 world positions of the vertices with ids (N,), i + nx*(j + ny*k)."""
        nx, ny, _ = self.dims
        ids = np.asarray(ids, np.int64)
        ijk = np.stack([ids % nx, ids // nx % ny, ids // (nx * ny)], -1)
        return np.asarray(self.origin) + self.edge * ijk

    def projection(self, camera: Camera) -> np.ndarray:
        """(3, 4) float64: vertex (i, j, k, 1) -> (u w, v w, w), with pixel (u, v) of the camera and
        depth w along its optical axis.
        """
        intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        offset = np.asarray(self.origin) - camera.eye
        return intrinsics @ camera.pose[:, :3].T @ np.column_stack([self.edge * np.eye(3), offset])


def smallest_edge(box: np.ndarray, cells: int) -> float:
    """Edge, within 0.1 %, of the finest grid over a (2, 3) box with at most `cells` vertices."""
    size = np.maximum(box[1] - box[0], 1e-6 * np.ptp(box))  # a box may be flat
    edge = (size.prod() / cells) ** (1 / 3)
    while (excess := np.prod(size // edge + 1) / cells) > 1:
        edge *= max(excess ** (1 / 3), 1.001)
    return float(edge)
