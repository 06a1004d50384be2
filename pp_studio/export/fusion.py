"""Fuses the depth maps of the training views into one signed distance field, a TSDF (Curless and
Levoy 1996).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pp_cl import Camera, RenderedView
from pp_cl.engine import Grid

TRUNCATION = 4.0  # of the distances, in voxel sizes: depths scatter by one or two
# What a view in which a vertex is hidden says for its being inside, in views. Without it, one ray
# that slips between the points hollows out what all other views hide.
HIDDEN = 0.03
COVERED = 0.5  # alpha from which a pixel shows the object
MARGIN = 2  # vertices around the points, so that the surface is closed
SLAB = 1 << 20  # vertices that are projected at once: 50 MB of temporary arrays


def box_around(grid: Grid, ids: np.ndarray) -> Grid:
    """The part of a grid around its vertices ids (N,), MARGIN wider on every side."""
    ijk = grid.coordinates(ids)
    first, last = ijk.min(0) - MARGIN, ijk.max(0) + MARGIN
    origin = np.asarray(grid.origin) + grid.voxel_size * first
    dims = tuple(int(n) for n in last - first + 1)
    return Grid(tuple(float(x) for x in origin), grid.voxel_size, dims)


def fuse(
    grid: Grid, views: Iterable[tuple[Camera, RenderedView]], hidden: float = HIDDEN
) -> np.ndarray:
    """(nz, ny, nx) float32 in [-1, 1]: the mean over the views of each vertex's distance to the
    surface that the renderings show, along the cameras' axes, in TRUNCATION voxel sizes, negative
    inside.

    A view says nothing of vertices outside its image, and counts as `hidden` views for those more
    than TRUNCATION voxel sizes behind its surface. What no view says anything of is inside.
    """
    total, count = (np.zeros(grid.dims[::-1], np.float32) for _ in range(2))
    nx, ny, nz = grid.dims
    layers = max(1, SLAB // (nx * ny))
    for camera, rendered in views:
        depth = np.where(rendered.alpha >= COVERED, rendered.median_depth, np.inf)
        for first in range(0, nz, layers):
            slab = slice(first, min(first + layers, nz))
            distance, shown = _distances(grid, camera, depth, slab)
            weight = np.where(distance > -1, 1, hidden) * shown
            total[slab] += distance * weight
            count[slab] += weight
    return np.where(count > 0, total / np.maximum(count, 1e-6), -1).astype(np.float32)


def _distances(grid, camera, depth, slab):
    """(the distances of a slab's vertices, float32, -1 where they are hidden; whether they are in
    the image), both (layers, ny, nx).
    """
    nx, ny, _ = grid.dims
    i, j, k = (
        np.arange(*ends, dtype=np.float32) for ends in ((nx,), (ny,), (slab.start, slab.stop))
    )
    j, k = j[:, None], k[:, None, None]
    across, down, z = (
        row[0] * i + row[1] * j + row[2] * k + row[3]
        for row in grid.projection(camera).astype(np.float32)
    )
    ahead = np.maximum(z, np.float32(1e-6))
    column, row = across / ahead, down / ahead
    shown = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixel = tuple(np.where(shown, at, 0).astype(np.int32) for at in (row, column))
    distance = (depth[pixel] - z) / np.float32(TRUNCATION * grid.voxel_size)
    return np.clip(distance, -1, 1), shown
