"""Points to camera axes, and the kind of footprint they have on the image."""

from dataclasses import dataclass

import numpy as np

LANES = 16  # of cl/raster/project.cl
KINDS = ("disc", "soft", "sphere")


@dataclass(frozen=True)
class Footprint:
    """What a point covers (cl/raster/footprint.h).

    kind: "disc" (the paper's hard disc: 0.75 pixels, or the radius if that is more), "soft"
    (closeness falls linearly to the same rim) or "sphere" (Pulsar's general spheres). Raises
    ValueError for another kind.
    """

    kind: str = "soft"

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"no such footprint: {self}")

    @property
    def defines(self):
        """{macro: value} for the programs that include footprint.h."""
        return {"FOOTPRINT": KINDS.index(self.kind)}


class Projection:
    """Where the points of one view are; the buffers are kept from view to view.

    point_camera: (N,4) float32, x, y, z in camera axes and the distance; (0, 0, 0, -1) for a point
    left out by Pulsar's culling rule. point_box: (N,4) uint16, first x, first y, last x, last y of
    the pixels that may be hit; none where last < first.
    """

    def __init__(self, dev, footprint):
        self.dev = dev
        self.program = dev.program("raster/project", **footprint.defines)
        self.point_camera = self.point_box = None

    def grid(self, view, grid, point_id, radius, dropout=0.0, seed=0):
        """Project vertices of a grid.

        view: (20) packed camera. grid: (8) packed Grid. point_id: (N) uint32. radius: one number
        for all. dropout: probability in [0, 1) with which each point is left out, at random by
        (seed, id). seed: uint32.
        """
        n = point_id.size
        self._resize(n)
        self.program.launch(
            "project_grid",
            -(-n // LANES),
            n=n,
            radius=radius,
            dropout=round(dropout * 2**32),
            seed=seed,
            camera=view,
            grid=grid,
            point_id=point_id,
            point_camera=self.point_camera,
            point_box=self.point_box,
        )

    def spheres(self, view, positions, point_radius):
        """Project spheres. positions: (N,3) float32, world. point_radius: (1) or (N) float32."""
        n = positions.shape[0]
        self._resize(n)
        self.program.launch(
            "project_spheres",
            -(-n // LANES),
            n=n,
            k=point_radius.size,
            camera=view,
            positions=positions,
            point_radius=point_radius,
            point_camera=self.point_camera,
            point_box=self.point_box,
        )

    def _resize(self, n):
        if self.point_camera is None or self.point_camera.shape[0] != n:
            self.point_camera = self.dev.empty((n, 4))
            self.point_box = self.dev.empty((n, 4), np.uint16)
