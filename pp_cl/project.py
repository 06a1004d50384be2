"""Points to camera axes, and the kind of footprint they have on the image."""

from dataclasses import dataclass

KINDS = ("disc", "soft", "sphere")


@dataclass(frozen=True)
class Footprint:
    """What a point covers (cl/footprint.h).

    kind: "disc" (the paper's hard disc of 0.75 pixels or the radius), "soft" (closeness falls linearly to the rim) or
    "sphere" (Pulsar's general spheres). in_pixels: radii are pixels at the image's centre instead of world units.
    """

    kind: str = "soft"
    in_pixels: bool = False

    @property
    def defines(self):
        """{macro: value} for the programs that include footprint.h."""
        return {"FOOTPRINT": KINDS.index(self.kind), "RADIUS_IN_PIXELS": int(self.in_pixels)}


def project_grid(dev, footprint, view, grid, point_id, radius, point_camera, dropout=0.0, seed=0):
    """Write (x, y, z, distance) in camera axes; distance -1 where a point is left out (Pulsar's culling rule).

    view: (20) packed camera. grid: (8) packed Grid. point_id: (N) uint32. radius: one number. point_camera: (N,4).
    dropout: probability in [0, 1) with which each point is left out, at random by (seed, grid id).
    """
    n = point_id.size
    dev.program("project", **footprint.defines).launch(
        "project_grid", n, n=n, radius=radius, dropout=round(dropout * 2**32), seed=seed, camera=view, grid=grid,
        point_id=point_id, point_camera=point_camera)


def project_spheres(dev, footprint, view, positions, point_radius, point_camera):
    """The same for positions (N,3) in world coordinates and radii (1) or (N)."""
    n = positions.shape[0]
    dev.program("project", **footprint.defines).launch(
        "project_spheres", n, n=n, k=point_radius.size, camera=view, positions=positions, point_radius=point_radius,
        point_camera=point_camera)
