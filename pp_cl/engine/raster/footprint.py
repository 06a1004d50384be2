"""The kinds of footprints that points have in an image: what differs between them."""

import math
from dataclasses import dataclass

from pp_cl.engine.device.device import Device

MOST_OFFSET = 0.5  # voxel sizes each way: keeps points in their cells, scales radii by 0.61 to 1.65
MOST_OF_GAUSSIANS = 2.0  # in voxel sizes, logarithms or deviations
MOST_SH_OF_GAUSSIANS = 127 / 128  # above degree 0: the largest that a .spz can hold


@dataclass(frozen=True)
class Footprint:
    """A kind of footprint; its header in cl/raster/footprint/ has the geometry.

    offsets: numbers in a row of PointCloud.offset, see cl/cloud.h; most_offset: their bound. shape:
    numbers in a row of point_shape, the radius or, of Gaussians, what maps pixels to deviations.
    moves: points learn offsets, if they are composited by alpha, and have radii in voxel sizes.
    most_sh: the bound of SH coefficients above degree 0; infinity if there is none. is_flat: a
    disc, whose pixels can have several samples, if it is composited by alpha: one list of fragments
    is right for all of them.
    """

    offsets: int = 4
    most_offset: float = MOST_OFFSET
    shape: int = 1
    moves: bool = False
    most_sh: float = math.inf
    is_flat: bool = False


FOOTPRINTS = {
    "disc": Footprint(is_flat=True),
    "soft": Footprint(is_flat=True, moves=True),
    "sphere": Footprint(),
    "gaussian": Footprint(16, MOST_OF_GAUSSIANS, 4, moves=True, most_sh=MOST_SH_OF_GAUSSIANS),
}


def footprint_macros(footprint: str, side: int = 1) -> dict[str, int | str]:
    """The defines of a program that includes cl/raster/footprint.h, for one of FOOTPRINTS and side
    x side samples in a pixel.
    """
    kind = FOOTPRINTS[footprint]
    return {
        "SIDE": side,
        "SAMPLES": side**2,
        "FOOTPRINT": footprint.upper(),
        "OFFSETS": kind.offsets,
        "SHAPE": kind.shape,
    }


def sample_macros(dev: Device, footprint: str, side: int) -> dict[str, int | str]:
    """The defines of a program whose lanes are the samples of a pixel, see cl/raster/samples.h."""
    return footprint_macros(footprint, side) | {"LANES": side**2, "ON_CPU": int(dev.is_cpu)}
