"""Points on a regular grid: which vertices exist, and what each one learns."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Grid:
    """A regular grid. origin: (3,) world position of vertex (0, 0, 0); edge: spacing, world units;
    dims: vertices.
    """

    origin: tuple
    edge: float
    dims: tuple

    def packed(self):
        """(8,) float32, the layout of cl/grid.h."""
        return np.array([*self.origin, self.edge, *self.dims, 0], np.float32)

    def positions(self, ids):
        """(N, 3) float64 world positions of vertex ids (i + nx*(j + ny*k))."""
        nx, ny, _ = self.dims
        ids = np.asarray(ids, np.int64)
        ijk = np.stack([ids % nx, ids // nx % ny, ids // (nx * ny)], -1)
        return np.asarray(self.origin) + self.edge * ijk
