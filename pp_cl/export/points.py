"""The points of a run with the colours that its network gives them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pp_cl.errors import UserError
from pp_cl.export.observe import observe
from pp_cl.files.image import to_8bit
from pp_cl.files.picture import Picture
from pp_cl.run import Run
from pp_cl.scene.camera import Camera

FINEST = 1e-3  # of the grid's edge: how far rounding to float32 may move a point in a file


@dataclass(frozen=True)
class ColouredPoints:
    """M points in the order of their ids.

    rows: (M,) int64, their rows in the run's point cloud. positions: (M, 3) as in_world() gives
    them. colours: (M, 3) uint8 sRGB. weight: (M,) float32, the blend weights in the view that gave
    the colour, summed over its pixels. opacity: (M,) float32.
    """

    rows: np.ndarray
    positions: np.ndarray
    colours: np.ndarray
    weight: np.ndarray
    opacity: np.ndarray


def coloured_points(run: Run, min_weight: float = 0.0) -> ColouredPoints:
    """The points that weigh more than min_weight in some training view, with their colours in the
    view where they weigh most: that of the pixel which shows their centre, without the background.

    No colour is invented for points that no training view shows: they are left out. Raises
    UserError where no point is left.
    """
    cloud = run.model.cloud
    positions = run.model.grid.positions(cloud.ids.get())
    colours, best = np.zeros((cloud.count, 3), np.uint8), np.zeros(cloud.count, np.float32)
    for seen in observe(run, run.cameras("train"), "colours"):
        weights = seen.point_weights()  # before the picture, which weighs the view anew
        higher = np.flatnonzero(weights > best)
        best[higher] = weights[higher]
        colours[higher] = _colours(seen.picture(), seen.camera, positions[higher])
    rows = np.flatnonzero(best > min_weight)
    if not len(rows):
        raise UserError(
            f"--min-weight {min_weight:g}: no point weighs more in any training view (at most "
            f"{best.max(initial=0):.3g}); lower it"
        )
    return ColouredPoints(
        rows,
        in_world(positions[rows], run.model.grid.edge),
        colours[rows],
        best[rows],
        cloud.opacity.get()[rows],
    )


def in_world(positions: np.ndarray, edge: float) -> np.ndarray:
    """(N, 3) float64 world positions as files keep them: float32, which every program reads, or
    float64 where the world's origin is so far that float32 moves them. edge: of the grid.
    """
    resolution = np.spacing(np.float32(np.abs(positions).max(initial=0)))
    return positions if resolution > FINEST * edge else positions.astype(np.float32)


def _colours(picture: Picture, camera: Camera, positions):
    """(M, 3) uint8: a point whose centre is just outside the image takes the nearest pixel."""
    x, y, z = ((positions - camera.eye) @ camera.pose[:, :3]).T
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    column = column.clip(0, camera.width - 1).astype(np.int64)  # a seen point has z > 0
    row = row.clip(0, camera.height - 1).astype(np.int64)
    return to_8bit(picture.rgba()[row, column, :3])
