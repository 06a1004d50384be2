"""View-dependent features of the visible points from their spherical harmonics coefficients."""

from __future__ import annotations

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, row_parts
from pp_cl.raster.points import four_blocks, stored_degree
from pp_cl.raster.project import ProjectedPoints


def shade_forward(
    dev: Device,
    points: ProjectedPoints,
    shaded: Array,
    sh: list[Array],
    *,
    point_features: Array,
) -> None:
    """Write the rows `shaded` of point_features (N, 16) float32.

    The direction of a point is normalize(point - eye) in world axes. shaded: (S,) uint32, the
    visible points. sh: of PointCloud.
    """
    sh_0, sh_1, sh_2a, sh_2b = four_blocks(sh)
    dev.program("raster/shade", LANES=lanes(dev), DEGREE=stored_degree(sh)).launch(
        "shade_forward_half" if sh_0.dtype == np.float16 else "shade_forward",
        shaded.size * row_parts(dev),
        s=shaded.size,
        shaded=shaded,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        sh_0=sh_0,
        sh_1=sh_1,
        sh_2a=sh_2a,
        sh_2b=sh_2b,
        point_features=point_features,
    )
