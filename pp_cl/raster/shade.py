"""View-dependent features of points from their spherical harmonics coefficients."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, row_parts
from pp_cl.raster.project import ProjectedPoints
from pp_cl.raster.sh import SH_BLOCKS, sh_arguments, stored_degree


def shade_forward(
    dev: Device,
    points: ProjectedPoints,
    shaded: Array,
    sh: Sequence[Array],
    *,
    point_features: Array,
) -> None:
    """Write the rows `shaded` of point_features (N, 16) float32.

    The direction of a point is normalize(point - eye) in world axes. shaded: (S,) uint32. sh: the
    coefficients, arrays (N, count, 16) of SH_BLOCKS up to the end of one degree, all of them
    float32 or all float16. Raises ValueError where they end within a degree or have another shape.
    """
    n = len(points.point_camera)
    for block, array in zip(SH_BLOCKS, sh, strict=False):
        if array.shape != (n, block.count, 16):
            raise ValueError(f"{block.name} has shape {array.shape}, not {(n, block.count, 16)}")
    dev.program("raster/shade", LANES=lanes(dev), DEGREE=stored_degree(len(sh))).launch(
        "shade_forward_half" if sh[0].dtype == np.float16 else "shade_forward",
        shaded.size * row_parts(dev),
        s=shaded.size,
        shaded=shaded,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        point_features=point_features,
        **sh_arguments(sh),
    )
