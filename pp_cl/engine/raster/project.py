"""Projection and culling: puts points in camera axes, and finds the box of pixels that each may
cover and how many it covers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, launch_groups, replayed
from pp_cl.engine.device.scan import BLOCK, blocks_of
from pp_cl.engine.raster.footprint import FOOTPRINTS, MOST_OFFSET, footprint_macros

LEAST_RADIUS = 0.75  # pixels, as in cl/raster/footprint.h


@dataclass(frozen=True)
class ProjectedPoints:
    """N points in one view, valid until the next projection.

    footprint: one of FOOTPRINTS. camera_buffer: (21,) float32, cl/camera.h. point_count: (N,)
    uint32, the number of pixels that the point covers; block_sum: (ceil(N/BLOCK),) uint32, the sums
    of point_count over blocks of BLOCK points. Where LANES consecutive points have no fragments,
    the other arrays are undefined. point_camera: (N, 4) float32, x, y, z in camera axes and the
    distance from the eye; (0, 0, 0, -1) for a culled point. point_box: (N, 4) uint16, first x,
    first y, last x, last y of the pixels that the point may cover; last < first means none.
    point_shape: (N, 1) float32, the radius in world units; for Gaussians (N, 4), maps pixels to
    deviations (cl/raster/footprint/gaussian.h). point_opacity: (N,) float32 in [0, 1], as seen from
    the eye; undefined for spheres. cloud_offset, radius: the arguments of project_grid(). side:
    samples of a pixel, each way; boxes and counts are in pixels, the camera is in samples.
    """

    footprint: str
    camera_buffer: Array
    point_camera: Array
    point_box: Array
    point_count: Array
    block_sum: Array
    point_shape: Array
    point_opacity: Array
    cloud_offset: Array | None = None
    radius: float = 0.0
    side: int = 1


def footprint_pixels(radius: float, side: int = 1) -> float:
    """The approximate number of pixels that a point covers, with side x side samples in each: the
    area of a disc, grown by the square that a pixel's sample centres span. radius: of the
    footprint, in pixels.
    """
    radius, apart = max(LEAST_RADIUS / side, radius), 1 - 1 / side
    return math.pi * radius**2 + 4 * radius * apart + apart**2


def projection_table(n: int, footprint: str = "soft") -> Table:
    """The buffers for n points."""
    return {
        "point_camera": ((n, 4), np.float32),
        "point_box": ((n, 4), np.uint16),
        "point_count": ((n,), np.uint32),
        "block_sum": ((blocks_of(n),), np.uint32),
        "point_shape": ((n, FOOTPRINTS[footprint].shape), np.float32),
        "point_opacity": ((n,), np.float32),
    }


def launch_projection(
    dev: Device,
    b: Buffers,
    file: str,
    kernel: str,
    n: int,
    footprint: str,
    side: int = 1,
    **arguments: Any,
) -> None:
    """Launch a kernel of cl/<file>.cl that projects n points with a footprint of FOOTPRINTS into
    the buffers b of projection_table().
    """
    launch_groups(
        dev,
        file,
        kernel,
        blocks_of(n),
        defines={
            "LANES": lanes(dev),
            "BLOCK": BLOCK,
            "MOST_OFFSET": f"{MOST_OFFSET}f",
            **footprint_macros(footprint, side),
        },
        n=n,
        point_camera=b.point_camera,
        point_shape=b.point_shape,
        point_box=b.point_box,
        point_count=b.point_count,
        block_sum=b.block_sum,
        **arguments,
    )


@replayed
def project_grid(
    dev: Device,
    b: Buffers,
    footprint: str,
    camera_buffer: Array,
    grid_buffer: Array,
    *,
    point_id: Array,
    cloud_offset: Array,
    opacity: Array,
    radius: float,
    side: int = 1,
) -> ProjectedPoints:
    """Project the points, each in the cell of a grid vertex, into a camera. If a pixel has side x
    side samples, the camera's pixels are the samples.

    grid_buffer: (8,) float32, Grid.packed(). point_id: (N,) uint32. cloud_offset: (N, 4) float32,
    PointCloud.offset; (N, 16) for Gaussians. opacity: (N, 9) float32, PointCloud.opacity. radius:
    the radius of points without offsets, in world units.
    """
    n = point_id.size
    b.require(projection_table(n, footprint))
    launch_projection(
        dev,
        b,
        "raster/project",
        "project_grid",
        n,
        footprint,
        side,
        camera=camera_buffer,
        grid=grid_buffer,
        point_id=point_id,
        radius=radius,
        cloud_offset=cloud_offset,
        opacity=opacity,
        point_opacity=b.point_opacity,
    )
    return ProjectedPoints(
        footprint,
        camera_buffer,
        b.point_camera,
        b.point_box,
        b.point_count,
        b.block_sum,
        b.point_shape,
        b.point_opacity,
        cloud_offset,
        radius,
        side,
    )
