"""Float64 twin of cl/scene/hull.cl: the mask of a view, and which positions the masks keep."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view


def dilated_mask(alpha: np.ndarray, threshold: int) -> np.ndarray:
    """(H, W) bool: some pixel of the 3x3 neighbourhood has an alpha above the threshold."""
    return sliding_window_view(np.pad(alpha > threshold, 1), (3, 3)).any((2, 3))


def kept(
    views: Sequence[Any], positions: np.ndarray, threshold: int
) -> tuple[np.ndarray, np.ndarray]:
    """((N,) bool kept, (N,) pixels to the nearest pixel border of any view that has the position
    before it).
    """
    seen = np.zeros(len(positions), bool)
    alive = np.ones(len(positions), bool)
    border = np.full(len(positions), np.inf)
    for view in views:
        camera, mask = view.stored_camera, dilated_mask(view.image[..., 3], threshold)
        x, y, z = camera.pose[:, :3].T @ (positions - camera.eye).T
        for n in np.flatnonzero(z > 0):
            u = camera.fx * x[n] / z[n] + camera.cx
            v = camera.fy * y[n] / z[n] + camera.cy
            border[n] = min(border[n], abs(u - round(u)), abs(v - round(v)))
            if 0 <= u < camera.width and 0 <= v < camera.height:
                seen[n] = True
                alive[n] &= mask[int(v), int(u)]
    return alive & seen, border
