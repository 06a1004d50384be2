"""Points in camera axes, and the box of pixels that each may cover."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes

KINDS = ("disc", "soft", "sphere")


@dataclass(frozen=True)
class Footprint:
    """What a point covers (cl/raster/footprint.h).

    kind: "disc" (the paper's hard disc: radius at least 0.75 pixels), "soft" (closeness falls
    linearly from the centre to the same rim) or "sphere" (Pulsar's general spheres). Raises
    ValueError for another kind.
    """

    kind: str = "soft"

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"no such footprint: {self}")

    @property
    def defines(self) -> dict[str, int]:
        """{macro: value} for the programs that include footprint.h."""
        return {"FOOTPRINT": KINDS.index(self.kind)}


@dataclass(frozen=True)
class ProjectedPoints:
    """N points in one view, valid until the next projection.

    camera_buffer: (20,) float32, cl/camera.h. point_camera: (N, 4) float32, x, y, z in camera axes
    and the distance from the eye; (0, 0, 0, -1) for a point that Pulsar's rule culls. point_box:
    (N, 4) uint16, first x, first y, last x, last y of the pixels that may be hit; last < first
    means none. point_count: (N,) uint32, pixels that are hit. point_radius: (1,) or (N,) float32,
    world units.
    """

    camera_buffer: Array
    point_camera: Array
    point_box: Array
    point_count: Array
    point_radius: Array


class Projection:
    """Projects points; the buffers are reused from view to view."""

    def __init__(self, dev: Device, footprint: Footprint):
        self._lanes = lanes(dev)
        self.program = dev.program("raster/project", LANES=self._lanes, **footprint.defines)
        self._buffers = Buffers(dev)

    @staticmethod
    def table(n: int) -> Table:
        """The buffers for n points."""
        return {
            "point_camera": ((n, 4), np.float32),
            "point_box": ((n, 4), np.uint16),
            "point_count": ((n,), np.uint32),
        }

    def grid(
        self,
        camera_buffer: Array,
        grid_buffer: Array,
        point_id: Array,
        point_radius: Array,
        *,
        dropout: float = 0.0,
        seed: int = 0,
    ) -> ProjectedPoints:
        """Project vertices of a grid.

        grid_buffer: (8,) float32, Grid.packed(). point_id: (N,) uint32. point_radius: (1,).
        dropout: probability in [0, 1) with which a point is left out, at random by (seed, id).
        seed: uint32.
        """
        return self._launch(
            "project_grid",
            point_id.size,
            camera_buffer,
            point_radius,
            dropout=round(dropout * 2**32),
            seed=seed,
            grid=grid_buffer,
            point_id=point_id,
        )

    def spheres(
        self, camera_buffer: Array, positions: Array, point_radius: Array
    ) -> ProjectedPoints:
        """Project spheres. positions: (N, 3) float32, world. point_radius: (1,) or (N,)."""
        return self._launch(
            "project_spheres",
            len(positions),
            camera_buffer,
            point_radius,
            radii=point_radius.size,
            positions=positions,
        )

    def _launch(self, kernel, n, camera_buffer, point_radius, **arguments):
        self._buffers.require(self.table(n))
        points = {name: getattr(self._buffers, name) for name in self.table(n)}
        self.program.launch(
            kernel,
            -(-n // self._lanes),
            n=n,
            camera=camera_buffer,
            point_radius=point_radius,
            **points,
            **arguments,
        )
        return ProjectedPoints(camera_buffer, point_radius=point_radius, **points)
