"""Projection and culling: puts points in camera axes, and finds the box of pixels that each may
cover and how many tiles it touches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, launch_groups, replayed
from pp_cl.engine.device.scan import BLOCK, blocks_of
from pp_cl.engine.raster.footprint import FOOTPRINTS, MOST_OFFSET, footprint_macros

LEAST_RADIUS = 0.75  # pixels, as in cl/raster/footprint.h
TILE = 16  # samples along a tile


@dataclass(frozen=True)
class ProjectedPoints:
    """N points in one view, valid until the next projection.

    footprint: one of FOOTPRINTS. camera_buffer: (21,) float32, cl/camera.h. point_count: (N,)
    uint32, the number of tiles that the point may cover, 0 if it is culled; block_sum:
    (ceil(N/BLOCK),) uint32, the sums of point_count over blocks of BLOCK points. point_record: (N,
    8) uint32, (N, 16) for Gaussians, what cl/raster/footprint.h keeps of a point, its place in
    camera axes, shape, opacity from the eye and box; undefined where point_count is 0.
    cloud_offset, radius: the arguments of project_grid(). supersampling: samples of a pixel, each
    way; boxes are in pixels, the camera is in samples.
    """

    footprint: str
    camera_buffer: Array
    point_record: Array
    point_count: Array
    block_sum: Array
    cloud_offset: Array
    radius: float
    supersampling: int = 1

    def macros(self) -> dict[str, int | str]:
        """footprint_macros() of these points."""
        return footprint_macros(self.footprint, self.supersampling)


def tiles_of(size: tuple[int, int], supersampling: int = 1) -> tuple[int, int]:
    """(rows, columns) of the tiles of an image (height, width). supersampling: samples of a pixel,
    each way.
    """
    return -(-size[0] * supersampling // TILE), -(-size[1] * supersampling // TILE)


def touched_tiles(radius: float, supersampling: int = 1) -> float:
    """The approximate number of tiles that the box of a point touches. radius: of the footprint, in
    pixels. supersampling: samples of a pixel, each way.
    """
    samples = 2 * max(LEAST_RADIUS, radius * supersampling)  # along its box
    return (1 + samples / TILE) ** 2


def projection_table(n: int, footprint: str = "soft") -> Table:
    """The buffers for n points."""
    return {
        "point_record": ((n, FOOTPRINTS[footprint].record), np.uint32),
        "point_count": ((n,), np.uint32),
        "block_sum": ((blocks_of(n),), np.uint32),
    }


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
    supersampling: int = 1,
) -> ProjectedPoints:
    """Project the points, each in the cell of a grid vertex, into a camera. If a pixel has several
    samples, the camera's pixels are the samples.

    grid_buffer: (8,) float32, Grid.packed(). point_id: (N,) uint32. cloud_offset: (N, 4) float32,
    PointCloud.offset; (N, 16) for Gaussians. opacity: (N, 9) float32, PointCloud.opacity. radius:
    the radius of points without offsets, in world units.
    """
    n = point_id.size
    b.require(projection_table(n, footprint))
    macros = {
        "BLOCK": BLOCK,
        "MOST_OFFSET": f"{MOST_OFFSET}f",
        **footprint_macros(footprint, supersampling),
    }
    launch_groups(
        dev,
        "raster/project",
        "project_grid",
        blocks_of(n),
        defines={"LANES": lanes(dev), **macros},
        n=n,
        camera=camera_buffer,
        grid=grid_buffer,
        point_id=point_id,
        radius=radius,
        cloud_offset=cloud_offset,
        opacity=opacity,
        point_record=b.point_record,
        point_count=b.point_count,
        block_sum=b.block_sum,
    )
    arrays = b.point_record, b.point_count, b.block_sum, cloud_offset
    return ProjectedPoints(footprint, camera_buffer, *arrays, radius, supersampling)
