"""The model: points in the cells of a grid with radii, opacities and SH coefficients, and the U-Net
that turns blended features into colours.
"""

from __future__ import annotations

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.network.first_features import FirstFeatures
from pp_cl.engine.network.specular import Specular
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import PointCloud

REFINING_BYTES = 320  # of host memory that refining uses for each point it replaces


class Model:
    """Points and network on a device.

    grid: each point lies in the cell of a vertex; grid_buffer: the packed grid, (8) float32 on the
    device. depth_range: (near, far), distances from the eye in world units, of all cameras.
    Positions on the device are relative to the grid's centre, which refinement does not move.
    specular: the layer fitted at the end of a training, or None.
    """

    def __init__(
        self,
        dev: Device,
        grid: Grid,
        depth_range: tuple[float, float],
        cloud: PointCloud,
        *,
        net: UNet | FirstFeatures,
        specular: Specular | None = None,
    ):
        self.dev = dev
        self.grid = grid
        self.grid_buffer = dev.upload(grid.packed(grid.centre))
        self.depth_range = depth_range
        self.cloud = cloud
        self.net = net
        self.specular = specular

    @property
    def extent(self) -> float:
        """Half of the grid's diagonal in world units, the unit of places for the specular layer."""
        return self.grid.diagonal / 2

    def positions(self) -> np.ndarray:
        """(N, 3) float64 world positions of the points."""
        vertices = self.grid.positions(self.dev.download(self.cloud.ids))
        return vertices + self.grid.voxel_size * self.dev.download(self.cloud.offset)[:, :3]

    def packed(self, camera: Camera, depth_range: tuple[float, float] | None = None) -> np.ndarray:
        """(21,) float32: the packed camera, relative to the same centre as grid_buffer.
        depth_range: replaces the model's.
        """
        return camera.packed(depth_range or self.depth_range, self.grid.centre)

    def refine(self) -> Array:
        """Densify: replace every point by the eight around it on the grid of half the spacing,
        which take over its offset, opacity and SH coefficients. Returns the row of each new point's
        parent, (8 N,) uint32.

        Raises ValueError as Grid.children() does.
        """
        ids, parents = self.grid.children(self.dev.download(self.cloud.ids))
        rows = self.dev.upload(parents)
        self.cloud.replace_by(self.dev, ids, rows)
        self.grid = self.grid.refined()
        self.grid_buffer = self.dev.upload(self.grid.packed(self.grid.centre))
        return rows
