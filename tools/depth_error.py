"""Compare the alpha and depth of a run of the demo with those of the object.

Over the test views: the share of the object's pixels whose depth is within 1.5 point spacings of
the exact one, and the intersection over union of alpha and mask.

    python tools/depth_error.py runs/demo
"""

import argparse
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from pp_cl import load
from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid, smallest_voxel_size
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.run import Run
from pp_cl.scene.demo import OBJECT_BOX, distances

CELLS = 2**24  # the most cells of the distance field
STEPS = 200  # of marching along a ray
NEAR = 1.5  # point spacings


class DemoSurface:
    """The demo's exact surface, found by marching through its distance field on a fine grid."""

    def __init__(self, dev: Device):
        box = np.array(OBJECT_BOX)
        self.grid = Grid.centred_in(box, smallest_voxel_size(box, CELLS))
        self.field = distances(dev, self.grid)

    def depth(self, camera: Camera) -> np.ndarray:
        """(H, W) float64 depth along the camera's axis at the pixels' centres, infinite where
        a ray misses the object.
        """
        rays = camera.rays()
        lengths = np.linalg.norm(rays, axis=-1)
        directions = rays / lengths[..., None]
        travelled = np.full(lengths.shape, np.linalg.norm(camera.eye) - 1.5)
        for _ in range(STEPS):
            distance, inside = self._at(camera.eye + directions * travelled[..., None])
            travelled += np.where(inside, distance, self.grid.voxel_size)
        distance, inside = self._at(camera.eye + directions * travelled[..., None])
        hit = inside & (np.abs(distance) < 0.2 * self.grid.voxel_size)
        return np.where(hit, travelled / lengths, np.inf)

    def _at(self, points):
        """(distances, whether inside the field) at world positions (..., 3)."""
        places = (points - self.grid.origin) / self.grid.voxel_size
        inside = ((places >= 0) & (places <= np.array(self.grid.dims) - 1)).all(axis=-1)
        return map_coordinates(self.field, places.T[::-1].swapaxes(1, 2), order=1), inside


@dataclass(frozen=True)
class DepthError:
    """Means over views. mean, median: share of pixels where the mean or median depth is near the
    exact one. overlap: intersection over union of alpha and mask.
    """

    mean: float
    median: float
    overlap: float


def near_share(
    depth: np.ndarray, exact: np.ndarray, object_pixels: np.ndarray, most: float
) -> float:
    """Share of the object's pixels whose depth is within `most` of the exact one."""
    return float((np.abs(depth[object_pixels] - exact[object_pixels]) < most).mean())


def overlap(one: np.ndarray, two: np.ndarray) -> float:
    """Intersection over union of two (H, W) bool images."""
    return float((one & two).sum() / (one | two).sum())


def depth_error(run: Run) -> DepthError:
    """The DepthError of a run of the demo. Raises UserError for another scene."""
    if run.config.scene.path != "demo":
        raise UserError(f"{run.folder}: is no run of the demo, whose depth alone is known exactly")
    surface, rows = DemoSurface(run.dev), []
    for view in run.scene("test").splits["test"]:
        rendered, k = run.render(view.camera), view.downscale
        stored = view.image[..., 3].reshape(view.camera.height, k, view.camera.width, k)
        mask = stored.mean(axis=(1, 3)) > 127.5
        exact = surface.depth(view.camera)
        on_object, most = mask & np.isfinite(exact), NEAR * run.model.grid.voxel_size
        depths = rendered.depth, rendered.median_depth
        shares = [near_share(depth, exact, on_object, most) for depth in depths]
        rows.append((*shares, overlap(rendered.alpha > 0.5, mask)))
    return DepthError(*np.mean(rows, axis=0).tolist())


def main() -> None:
    """Print the error of a run."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("run_folder", metavar="RUN")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write it there too")
    options = parser.parse_args()
    error = depth_error(load(options.run_folder))
    print(f"within {NEAR} spacings: mean depth {error.mean:.3f}, median depth {error.median:.3f}")
    print(f"alpha and mask: intersection over union {error.overlap:.3f}")
    if options.json:
        write_json(options.json, asdict(error))


if __name__ == "__main__":
    main()
