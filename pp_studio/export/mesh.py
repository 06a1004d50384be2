"""The surface of a run as a mesh with coloured vertices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from pp_cl import Run, track
from pp_cl.errors import UserError
from pp_studio.export.fusion import box_around, fuse
from pp_studio.export.gltf import gltf_colours, write_glb
from pp_studio.export.points import (
    ColouredPoints,
    coloured_points,
    in_world,
    inside,
    place_and_colour,
    table_of,
    write_elements,
)

NEIGHBOURS = 4  # points that colour a vertex


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
    outside = np.pad(distances, 1, constant_values=1)  # closes what no view shows
    if outside.min() >= 0:
        raise UserError(f"{run.folder}: the training views show no surface; train it longer")
    vertices, faces, _, _ = marching_cubes(outside, 0, gradient_direction="ascent")
    positions = np.asarray(grid.origin) + grid.voxel_size * (vertices[:, ::-1] - 1)
    faces = faces[inside(positions, box)[faces].all(1)]
    if not len(faces):
        raise UserError(
            f"--box: holds no whole face of the mesh, whose sides are about {grid.voxel_size:.3g};"
            " make it larger"
        )
    used, faces = np.unique(faces, return_inverse=True)
    return in_world(positions[used], grid.voxel_size), faces.reshape(-1, 3).astype(np.int32)


def coloured_mesh(run: Run, box: np.ndarray | None = None) -> Mesh:
    """surface(), each vertex in the mean colour of the nearest points by their weight over the
    squared distance.
    """
    vertices, faces = surface(run, box)
    return Mesh(
        vertices, faces, _colours(vertices, coloured_points(run), run.model.grid.voxel_size)
    )


def _colours(vertices, points: ColouredPoints, voxel_size):
    """(V, 3) uint8."""
    count = min(NEIGHBOURS, len(points.rows))
    distance, near = cKDTree(points.positions).query(vertices, list(range(1, count + 1)))
    weight = points.weight[near] / (distance**2 + voxel_size**2)
    mean = (weight[..., None] * points.colours[near]).sum(1) / weight.sum(1, keepdims=True)
    return np.rint(mean).astype(np.uint8)


def write_mesh(path: Path | str, mesh: Mesh) -> None:
    """Write a PLY or GLB file, by the suffix. Raises UserError as atomic_file does."""
    if Path(path).suffix.lower() == ".glb":
        near = mesh.vertices - mesh.vertices.mean(0)
        normals = trimesh.Trimesh(near, mesh.faces, process=False).vertex_normals  # else all flat
        attributes = {
            "POSITION": mesh.vertices,
            "NORMAL": normals.astype(np.float32),
            "COLOR_0": gltf_colours(mesh.colours / 255),
        }
        write_glb(path, attributes, faces=mesh.faces)
        return
    faces = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    vertices = table_of(place_and_colour(mesh.vertices, mesh.colours))
    write_elements(path, {"vertex": vertices, "face": faces})
