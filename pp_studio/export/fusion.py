"""Fuses the depth maps of training views into a signed distance field, a TSDF (Curless and Levoy
1996), and closes it where no view shows anything.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from pp_cl import Camera, RenderedView
from pp_cl.engine import Grid

TRUNCATION = 4.0  # distances are clipped at this many voxel sizes; depths scatter by one or two
# The weight, in views, with which a view that does not see a vertex says that it is inside. Without
# it, one ray that slips between the points hollows out what all other views hide.
HIDDEN = 0.03
COVERED = 0.5  # alpha from which a pixel shows the object
SEEN = 2  # views that must show a surface near a vertex; one alone may be wrong
MARGIN = 2  # vertices added around the points, so that the surface is closed
SLAB = 1 << 20  # vertices projected at once: 50 MB of temporary arrays
PLANES = 1 << 21  # distances from vertices to planes compared at once


class Fused(NamedTuple):
    """What the views tell about a grid's vertices; each field is (nz, ny, nx) float32.

    distances: in [-1, 1], the mean over the views of each vertex's distance to the surface they
    show, along the cameras' axes, in TRUNCATION voxel sizes, negative inside. near: how many views
    show their surface within TRUNCATION voxel sizes of it. scatter: the standard deviation of the
    distances in these views, in voxel sizes.
    """

    distances: np.ndarray
    near: np.ndarray
    scatter: np.ndarray


def box_around(grid: Grid, ids: np.ndarray) -> Grid:
    """The part of a grid that holds its vertices ids (N,), MARGIN wider on every side."""
    ijk = grid.coordinates(ids)
    first, last = ijk.min(0) - MARGIN, ijk.max(0) + MARGIN
    origin = np.asarray(grid.origin) + grid.voxel_size * first
    return Grid(tuple(origin.tolist()), grid.voxel_size, tuple((last - first + 1).tolist()))


def fuse(grid: Grid, views: Iterable[tuple[Camera, RenderedView]], hidden: float = HIDDEN) -> Fused:
    """Fuse the depth maps of views at a grid's vertices.

    A view ignores vertices outside its image, and counts as `hidden` views for those more than
    TRUNCATION voxel sizes behind its surface. Vertices that all views ignore are inside.
    """
    total, count, near, first_moment, second_moment = (
        np.zeros(grid.dims[::-1], np.float32) for _ in range(5)
    )
    i, j, k = (np.arange(n, dtype=np.float32) for n in grid.dims)
    j, k, layers = j[:, None], k[:, None, None], max(1, SLAB // (len(i) * len(j)))
    for camera, rendered in views:
        depth = np.where(rendered.alpha >= COVERED, rendered.median_depth, np.inf)
        for first in range(0, len(k), layers):
            slab = slice(first, first + layers)
            across, down, z = (
                row[0] * i + row[1] * j + row[2] * k[slab] + row[3]
                for row in grid.projection(camera).astype(np.float32)
            )
            ahead = np.maximum(z, np.float32(1e-6))
            column, row = across / ahead, down / ahead
            shown = (z > 0) & (column >= 0) & (column < camera.width)
            shown &= (row >= 0) & (row < camera.height)
            pixel = tuple(np.where(shown, at, 0).astype(np.int32) for at in (row, column))
            distance = (depth[pixel] - z) / np.float32(TRUNCATION * grid.voxel_size)
            distance = np.clip(distance, -1, 1)  # -1 where a vertex is hidden
            weight = np.where(distance > -1, 1, hidden) * shown
            total[slab] += distance * weight
            count[slab] += weight
            is_near = shown & (np.abs(distance) < 1)
            near[slab] += is_near
            first_moment[slab] += distance * is_near
            second_moment[slab] += distance**2 * is_near
    times = np.maximum(near, 1)
    variance = np.maximum(second_moment / times - (first_moment / times) ** 2, 0)
    distances = np.where(count > 0, total / np.maximum(count, 1e-6), -1).astype(np.float32)
    return Fused(distances, near, np.float32(TRUNCATION) * np.sqrt(variance))


def closed(grid: Grid, fused: Fused, points: np.ndarray) -> np.ndarray:
    """The distances of a grid's vertices, with the object cut at the convex hull of its points
    (N, 3) where fewer than SEEN views show a surface: a base that no camera saw is flat.
    """
    distances = fused.distances.copy()
    try:
        planes = np.unique(ConvexHull(points).equations.round(9), axis=0)
    except QhullError:  # all points lie in one plane
        return distances
    unseen = np.flatnonzero((fused.near < SEEN) & (distances < 0))
    normals, offsets = (
        planes[:, :3].T.astype(np.float32),
        planes[:, 3] + points.mean(0) @ planes[:, :3].T,
    )
    nx, ny, _ = grid.dims
    corner = np.asarray(grid.origin) - points.mean(0)
    for part in np.array_split(unseen, len(unseen) * len(planes) // PLANES + 1):
        ijk = np.stack([part % nx, part // nx % ny, part // (nx * ny)], 1)
        places = (corner + grid.voxel_size * ijk).astype(np.float32)
        outside = (places @ normals + offsets.astype(np.float32)).max(1)
        outside /= np.float32(TRUNCATION * grid.voxel_size)
        distances.flat[part] = np.maximum(distances.flat[part], outside.clip(-1, 1))
    return distances
