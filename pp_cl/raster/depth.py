"""Alpha and depth of a view, from the blend weights of its pixels."""

from __future__ import annotations

from typing import NamedTuple

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.raster.blend_weights import PixelWeights
from pp_cl.raster.pairs import Pairs
from pp_cl.raster.project import ProjectedPoints


class AlphaDepth(NamedTuple):
    """What the points alone tell of a view, before the network; float32 arrays (H, W).

    alpha: share of the pixel that is not background, in [0, 1]. depth: along the camera's axis,
    world units, mean by blend weight; median: where half of the weight is reached, interpolated
    between hits; both infinite where alpha is 0.
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
    size: tuple[int, int],
) -> AlphaDepth:
    """AlphaDepth of the view that points, pairs and weights belong to. size: (H, W)."""
    found = AlphaDepth(*(dev.empty(size) for _ in range(3)))
    dev.program("raster/depth").launch(
        "depth_forward",
        pairs.pixels,
        hw=pairs.pixels,
        pixel_offset=pairs.pixel_offset,
        pixel_entry=weights.pixel_entry,
        point_camera=points.point_camera,
        pixel_alpha=found.alpha,
        pixel_depth=found.depth,
        pixel_median=found.median,
    )
    return found
