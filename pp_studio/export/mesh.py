"""The surface of a run as a mesh with coloured vertices: by the depth maps of the training views,
which are fused into one signed distance field, a TSDF (Curless and Levoy 1996).
"""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from pp_cl import Camera, RenderedView, Run, track
from pp_cl.engine import Grid
from pp_cl.errors import UserError
from pp_cl.files import atomic_file
from pp_studio.export.gltf import gltf_colours, write_glb
from pp_studio.export.points import (
    coloured_points,
    in_world,
    inside,
    place_and_colour,
    write_vertices,
)

NEIGHBOURS = 4  # points that colour a vertex
TRUNCATION = 4.0  # of the distances, in voxel sizes: depths scatter by one or two
# What a view in which a vertex is hidden says for its being inside, in views. Without it, one ray
# that slips between the points hollows out what all other views hide.
HIDDEN = 0.03
COVERED = 0.5  # alpha from which a pixel shows the object
# Standard deviation, in voxel sizes, of the Gaussian that smooths the field. On the demo, whose
# surface is known, neighbouring faces then differ by 7.1 degrees, not 10.0, and vertices lie no
# farther from it.
SMOOTHING = 0.7
LOOSE = 0.02  # of the largest part's faces: parts with fewer are left out
MARGIN = 2  # vertices around the points, so that the surface is closed
SLAB = 1 << 20  # vertices that are projected at once: 50 MB of temporary arrays


@dataclass(frozen=True)
class Mesh:
    """vertices: (V, 3) as in_world() gives them. faces: (F, 3) int32, counter-clockwise from
    outside. colours: (V, 3) uint8 sRGB.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray


def surface(run: Run, box: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(vertices (V, 3) of in_world(), faces (F, 3) int32) of the surface that the depths of the
    training views agree on, by marching cubes; with a box (2, 3) only the faces in it. Raises
    UserError where there is none.
    """
    grid = box_around(run.model.grid, run.model.cloud.ids.get())
    cameras = track(run.cameras("train"), "depths", "view")
    distances = fuse(grid, ((camera, run.render(camera)) for camera in cameras))
    # its border closes what no view shows
    outside = gaussian_filter(
        np.pad(distances, MARGIN, constant_values=1), SMOOTHING, mode="nearest"
    )
    if outside.min() >= 0:
        raise UserError(f"{run.folder}: the training views show no surface; train it longer")
    vertices, faces, _, _ = marching_cubes(outside, 0, gradient_direction="ascent")
    positions = np.asarray(grid.origin) + grid.voxel_size * (vertices[:, ::-1] - MARGIN)
    faces = _large_parts(faces, len(positions))
    faces = faces[inside(positions, box)[faces].all(1)]
    if not len(faces):
        raise UserError(
            f"--box: holds no whole face of the mesh, whose sides are about {grid.voxel_size:.3g};"
            " make it larger"
        )
    used, faces = np.unique(faces, return_inverse=True)
    return in_world(positions[used], grid.voxel_size), faces.reshape(-1, 3).astype(np.int32)


def _large_parts(faces, vertices):
    """The faces (F, 3) of parts that are no crumbs beside the largest one; says how many are."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(vertices, vertices))
    _, part = connected_components(graph, directed=False)
    sizes = np.bincount(part[faces[:, 0]])
    is_large = sizes >= LOOSE * sizes.max()
    if crumbs := np.count_nonzero(sizes[~is_large]):
        told = f"the surface: {crumbs} loose parts are left out, {sizes[~is_large].sum()} faces"
        warnings.warn(f"{told} of {len(faces)}", stacklevel=3)
    return faces[is_large[part[faces[:, 0]]]]


def coloured_mesh(run: Run, box: np.ndarray | None = None) -> Mesh:
    """surface(), with the mean colours of the nearest points by weight over squared distance."""
    (vertices, faces), points = surface(run, box), coloured_points(run)
    count = min(NEIGHBOURS, len(points.rows))
    distance, near = cKDTree(points.positions).query(vertices, list(range(1, count + 1)))
    weight = points.weight[near] / (distance**2 + run.model.grid.voxel_size**2)
    mean = (weight[..., None] * points.colours[near]).sum(1) / weight.sum(1, keepdims=True)
    return Mesh(vertices, faces, np.rint(mean).astype(np.uint8))


def write_mesh(path: Path | str, mesh: Mesh) -> None:
    """Write a PLY, GLB, OBJ or STL file, by the suffix. Raises UserError as atomic_file does."""
    suffix = Path(path).suffix.lower()
    if suffix in (".obj", ".stl"):
        solid = trimesh.Trimesh(
            mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False
        )
        data: Any = solid.export(file_type=suffix[1:])
        with atomic_file(Path(path)) as file:
            file.write(data.encode() if isinstance(data, str) else data)
    elif suffix == ".glb":
        near = mesh.vertices - mesh.vertices.mean(0)
        normals = trimesh.Trimesh(near, mesh.faces, process=False).vertex_normals  # else all flat
        attributes = {
            "POSITION": mesh.vertices,
            "NORMAL": normals.astype(np.float32),
            "COLOR_0": gltf_colours(mesh.colours / 255),
        }
        write_glb(path, attributes, faces=mesh.faces)
    else:
        write_vertices(path, place_and_colour(mesh.vertices, mesh.colours), mesh.faces)


def box_around(grid: Grid, ids: np.ndarray) -> Grid:
    """The part of a grid around its vertices ids (N,), MARGIN wider on every side."""
    ijk = grid.coordinates(ids)
    first, last = ijk.min(0) - MARGIN, ijk.max(0) + MARGIN
    origin = np.asarray(grid.origin) + grid.voxel_size * first
    return Grid(tuple(origin.tolist()), grid.voxel_size, tuple((last - first + 1).tolist()))


def fuse(
    grid: Grid, views: Iterable[tuple[Camera, RenderedView]], hidden: float = HIDDEN
) -> np.ndarray:
    """(nz, ny, nx) float32 in [-1, 1]: the mean over the views of each vertex's distance to what
    they show, along the cameras' axes, in TRUNCATION voxel sizes, negative inside.

    A view says nothing of vertices outside its image, and counts as `hidden` views for those more
    than TRUNCATION voxel sizes behind its surface. What no view says anything of is inside.
    """
    total, count = (np.zeros(grid.dims[::-1], np.float32) for _ in range(2))
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
    return np.where(count > 0, total / np.maximum(count, 1e-6), -1).astype(np.float32)
