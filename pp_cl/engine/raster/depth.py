"""Alpha, mean depth and median depth of each pixel, from its blend weights; no network."""

from __future__ import annotations

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.raster.footprint import sample_macros
from pp_cl.engine.raster.pairs import Pairs
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.raster.weights import BlendWeights


def depth_forward(
    dev: Device,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    size: tuple[int, int],
    voxel_size: float = 0.0,
) -> tuple[Array, Array, Array]:
    """(alpha, depth, median) of the view that points, pairs and weights belong to, float32 (H, W).

    alpha: share of the pixel that is not background, in [0, 1]; 1 after an early stop. depth: mean
    depth of the surface along the camera's axis, by blend weight, in world units; median: where the
    weights reach half of their sum, interpolated between fragments; both are infinite where alpha
    is 0. size: (H, W). voxel_size: depth and median average only the samples of a pixel within this
    distance of the nearest one, in world units.
    """
    alpha, depth, median = (dev.empty(size) for _ in range(3))
    dev.program("raster/depth", **sample_macros(dev, points.footprint, points.side)).launch(
        "depth_forward",
        pairs.pixels,
        hw=pairs.pixels,
        early_stop=weights.early_stop,
        voxel_size=voxel_size,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        point_shape=points.point_shape,
        pixel_offset=pairs.pixel_offset,
        pair_key=pairs.pair_key,
        pair_point_falloff=pairs.pair_point_falloff,
        pixel_weight_point=weights.pixel_weight_point,
        opacity=weights.opacity,
        pixel_alpha=alpha,
        pixel_depth=depth,
        pixel_median=median,
    )
    return alpha, depth, median
