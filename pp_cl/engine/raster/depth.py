"""Alpha, mean depth and median depth of each pixel, from its blend weights; no network."""

from __future__ import annotations

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.raster.pairs import Pairs, launch_tiles
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.raster.weights import BlendWeights


def depth_forward(
    dev: Device,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    voxel_size: float = 0.0,
) -> tuple[Array, Array, Array]:
    """(alpha, depth, median) of the view that points, pairs and weights belong to, float32 (H, W).

    alpha: share of the pixel that is not background, in [0, 1]; 1 after an early stop. depth: mean
    depth of the surface along the camera's axis, by blend weight, in world units; median: where the
    weights reach half of their sum, interpolated between fragments; both are infinite where alpha
    is 0. voxel_size: depth and median average only the samples of a pixel within this distance of
    the nearest one, in world units.
    """
    alpha, depth, median = (dev.empty(pairs.size) for _ in range(3))
    launch_tiles(
        dev,
        "raster/depth",
        "depth_forward",
        points,
        pairs,
        voxel_size=voxel_size,
        pixel_alpha=alpha.reshape(-1),
        pixel_depth=depth.reshape(-1),
        pixel_median=median.reshape(-1),
        **weights.walk(),
    )
    return alpha, depth, median
