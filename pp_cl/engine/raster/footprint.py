"""The kinds of footprints that points have in an image: what differs between them."""

import math
from dataclasses import dataclass

MOST_OFFSET = 0.5  # voxel sizes each way: keeps points in their cells, scales radii by 0.61 to 1.65
MOST_OF_GAUSSIANS = 2.0  # in voxel sizes, logarithms or deviations
MOST_SH_OF_GAUSSIANS = 127 / 128  # above degree 0: the largest that a .spz can hold


@dataclass(frozen=True)
class Footprint:
    """A kind of footprint; its header in cl/raster/footprint/ has the geometry.

    offsets: numbers in a row of PointCloud.offset, see cl/cloud.h; most_offset: their bound.
    record: words of a point's record in a view. moves: points learn offsets, if they are composited
    by alpha, and have radii in voxel sizes. most_sh: the bound of SH coefficients above degree 0;
    infinity if there is none. is_disc: pixels can have several samples, if they are composited by
    alpha.
    """

    offsets: int = 4
    most_offset: float = MOST_OFFSET
    record: int = 8
    moves: bool = False
    most_sh: float = math.inf
    is_disc: bool = False


FOOTPRINTS = {
    "disc": Footprint(is_disc=True),
    "soft": Footprint(is_disc=True, moves=True),
    "gaussian": Footprint(16, MOST_OF_GAUSSIANS, 16, moves=True, most_sh=MOST_SH_OF_GAUSSIANS),
}


def footprint_macros(footprint: str, supersampling: int = 1) -> dict[str, int | str]:
    """The defines of a program that includes cl/raster/footprint.h, for one of FOOTPRINTS.
    supersampling: samples of a pixel, each way.
    """
    kind = FOOTPRINTS[footprint]
    return {
        "SUPERSAMPLING": supersampling,
        "FOOTPRINT": footprint.upper(),
        "OFFSETS": kind.offsets,
        "RECORD": kind.record,
    }
