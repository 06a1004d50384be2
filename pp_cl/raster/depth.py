"""Alpha and depth of a view, from the blend weights of its pixels."""

from __future__ import annotations

from typing import NamedTuple

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.raster.blend_weights import PixelWeights
from pp_cl.raster.pairs import Pairs
from pp_cl.raster.project import Footprint, ProjectedPoints


class AlphaDepth(NamedTuple):
    """What the points alone tell of a view, before the network; float32 arrays (H, W).

    alpha: share of the pixel that is not background, in [0, 1]. depth: of the surface, along the
    camera's axis, world units, mean by blend weight; median: where half of the weight is reached,
    interpolated between hits; both infinite where alpha is 0.
    """

    alpha: Array
    depth: Array
    median: Array


def depth_forward(
    dev: Device,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: PixelWeights,
    *,
    footprint: Footprint,
    size: tuple[int, int],
) -> AlphaDepth:
    """AlphaDepth of the view that points, pairs and weights belong to. footprint: theirs. size:
    (H, W).
    """
    found = AlphaDepth(*(dev.empty(size) for _ in range(3)))
    defines = {"HAS_ROLES": int(weights.has_roles), **footprint.defines}
    dev.program("raster/depth", **defines).launch(
        "depth_forward",
        pairs.pixels,
        hw=pairs.pixels,
        radii=points.point_radius.size,
        camera=points.camera_buffer,
        point_radius=points.point_radius,
        pixel_offset=pairs.pixel_offset,
        pair_key=pairs.pair_key,
        pair_point_closeness=pairs.pair_point_closeness,
        pair_weight=weights.pair_weight,
        pair_role=weights.pair_role,
        pixel_alpha=found.alpha,
        pixel_depth=found.depth,
        pixel_median=found.median,
    )
    return found
