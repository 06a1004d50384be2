"""How the spherical harmonics of the points are stored: which coefficients lie in which array."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ShBlock:
    """SH coefficients that one array (N, count, 16) holds: `count` of one degree, from the basis'
    `first` on.
    """

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


# Degree 2 lies in two arrays: no array takes more than 192 bytes a point, so that 4.04 million
# points fit devices that allocate at most 1 GiB at once. The layout is the same everywhere, and so
# are the bits.
SH_BLOCKS = (ShBlock(0, 1), ShBlock(1, 3), ShBlock(4, 3), ShBlock(7, 2))


SH_DEGREES = (0, 1, 2)


def sh_blocks(degree):
    """Those of SH_BLOCKS up to a degree."""
    return tuple(block for block in SH_BLOCKS if block.degree <= degree)
