"""The part of an image in which points can be."""

import numpy as np

from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.scene.outline import project

# pixels: where a window begins, since the U-Net halves its input twice; and its sides, as long as
# they are inside the image, so that the frames of a film differ little in size
PLACE, MULTIPLE = 4, 32


class ObjectWindow:
    """Finds the window of a camera's image around all points.

    grid, ids: (N,), ascending, of the points. radius: theirs, in world units. margin: pixels around
    them.
    """

    def __init__(self, grid: Grid, ids: np.ndarray, radius: float, margin: int):
        self._corners = grid.positions(hull_candidates(grid, ids))
        self._radius, self._margin = radius, margin

    def crop(self, camera: Camera) -> tuple[Camera, int, int]:
        """(the camera of the window, its first column, its first row); all of the image where a
        point is beside or behind the eye, a few pixels of it where none is in the image.
        """
        x, y, depth = project(camera, self._corners)
        if not depth.min() > self._radius:
            return camera, 0, 0
        reach = self._radius / (depth - self._radius)
        left, width = self._interval(x, reach, camera.fx, centre=camera.cx, size=camera.width)
        top, height = self._interval(y, reach, camera.fy, centre=camera.cy, size=camera.height)
        return camera.crop(left, top, width, height), left, top

    def _interval(self, places, reach, focal, *, centre, size):
        """(first, length) of the pixels along an axis that balls around `places` touch, and the
        margin. reach: radius over depth.
        """
        slant = np.hypot(1, (places - centre) / focal)
        pixels = reach * slant * focal + self._margin
        first = int(np.clip(np.floor((places - pixels).min()), 0, size - 1)) // PLACE * PLACE
        end = int(np.clip(np.ceil((places + pixels).max()), first + 1, size))
        return first, min(-(-(end - first) // MULTIPLE) * MULTIPLE, size - first)


def hull_candidates(grid: Grid, ids: np.ndarray) -> np.ndarray:
    """Those of the ids (N,), ascending, that are first or last on their line of the grid along
    each axis: all vertices of the convex hull of the points are among them.
    """
    ids = np.asarray(ids, np.int64)
    keep, stride = np.ones(len(ids), bool), 1
    for dim in grid.dims:
        line = ids - ids // stride % dim * stride
        order = np.argsort(line, kind="stable")  # ascending along each line
        ends = np.diff(line[order], prepend=-1, append=-1) != 0
        keep[order] &= ends[:-1] | ends[1:]
        stride *= dim
    return ids[keep]
