"""Points on a regular grid: which vertices exist, and what each one learns."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ShBlock:
    """SH coefficients that one array (N, count, 16) holds: `count` of one degree, from the basis' `first` on."""

    first: int
    count: int

    @property
    def name(self):
        """Its key in Model.points."""
        return f"sh{self.first}"

    @property
    def degree(self):
        """0, 1 or 2."""
        return math.isqrt(self.first)


# Degree 2 lies in two arrays: no array takes more than 192 bytes a point, so that 4.04 million points fit devices that
# allocate at most 1 GiB at once. The layout is the same everywhere, and so are the bits.
SH_BLOCKS = (ShBlock(0, 1), ShBlock(1, 3), ShBlock(4, 3), ShBlock(7, 2))
SH_DEGREES = (0, 1, 2)


def sh_blocks(degree):
    """Those of SH_BLOCKS up to a degree."""
    return tuple(block for block in SH_BLOCKS if block.degree <= degree)


@dataclass(frozen=True)
class Grid:
    """A regular grid. origin: (3,) world position of vertex (0, 0, 0); edge: spacing, world units; dims: vertices."""

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
