"""The outline of points in a view."""

import math

import numpy as np
from skimage.morphology import closing, disk
from skimage.segmentation import find_boundaries

from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.scene.hull import spacing_pixels


def silhouette(grid: Grid, ids: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: the pixels that the points with these ids (N,) cover, gaps between neighbours
    closed.
    """
    gap = math.ceil(spacing_pixels(grid, [camera])) + 1
    x, y, depth = project(camera, grid.positions(ids))
    columns, rows = np.floor(x) + gap, np.floor(y) + gap
    marked = np.zeros((camera.height + 2 * gap, camera.width + 2 * gap), bool)
    inside = (depth > 0) & (columns >= 0) & (columns < marked.shape[1])
    inside &= (rows >= 0) & (rows < marked.shape[0])
    marked[rows[inside].astype(int), columns[inside].astype(int)] = True
    return closing(marked, disk(gap))[gap:-gap, gap:-gap]


def outline(grid: Grid, ids: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: the border of the silhouette, two pixels wide."""
    return find_boundaries(silhouette(grid, ids, camera), mode="thick")


def project(camera: Camera, positions: np.ndarray) -> np.ndarray:
    """(3, N) float64: x and y in pixels and the depth of (N, 3) world positions; those that are not
    in front of the camera are in its centre.
    """
    right, down, depth = camera.pose[:, :3].T @ (positions - camera.eye).T
    ahead = np.where(depth > 0, depth, np.inf)
    return np.stack(
        [camera.fx * right / ahead + camera.cx, camera.fy * down / ahead + camera.cy, depth]
    )
