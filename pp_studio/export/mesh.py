"""Makes the surface of a run as a mesh with coloured vertices, by marching cubes in the field to
which the depth maps of its training views are fused.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from pp_cl import Run, track
from pp_cl.errors import UserError
from pp_cl.files import atomic_file
from pp_studio.export.fusion import MARGIN, SEEN, box_around, closed, fuse
from pp_studio.export.gltf import gltf_colours, write_glb
from pp_studio.export.points import (
    coloured_points,
    in_world,
    inside,
    place_and_colour,
    write_vertices,
)

NEIGHBOURS = 4  # points that colour a vertex
# Two Gaussians with these standard deviations, in voxel sizes, smooth the field; the lesser value
# is taken. The finer keeps thin parts, the coarser closes the pits and tunnels that noise makes.
# This keeps all the demo's spokes (Euler number -30); with 0.7 alone, 22 of them break.
SMOOTHING = 0.5, 1.0
LOOSE = 0.02  # parts with less than this share of the largest part's faces are left out
# How strongly fair() holds a vertex to its place, relative to the square of its distance from the
# mean of its neighbours: where views agree; the scatter of depths, in voxel sizes, at which this
# halves; and where no view shows the vertex.
HELD, SCATTER, UNSEEN = 0.3, 0.85, 0.003
SEEN_FACES = "seen_faces"  # the name of this count in files
STEPS = 300  # most steps of conjugate gradients


@dataclass(frozen=True)
class Mesh:
    """vertices: (V, 3) as in_world() gives them. faces: (F, 3) int32, counter-clockwise from
    outside. colours: (V, 3) uint8 sRGB. seen: training views show this many of the faces, the first
    ones; the others are guessed.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray
    seen: int


@dataclass(frozen=True)
class Surface:
    """vertices: (V, 3) float64, world. faces: (F, 3) int32, counter-clockwise from outside. seen:
    (V,) bool, whether at least SEEN training views have depths near the vertex.
    """

    vertices: np.ndarray
    faces: np.ndarray
    seen: np.ndarray


def surface(run: Run, box: np.ndarray | None = None) -> Surface:
    """The surface on which the depths of the training views agree, closed where they show none.
    box: (2, 3); only the faces in it are kept. Raises UserError if there are none.
    """
    grid = box_around(run.model.grid, run.model.cloud.ids.get())
    cameras = track(run.cameras("train"), "depths", "view")
    fused = fuse(grid, ((camera, run.render(camera)) for camera in cameras))
    opacity = run.model.cloud.opacity.get()[:, 0]
    solid = run.model.positions()[opacity >= np.median(opacity)]
    # the padding closes the surface where no view shows it
    outside = np.pad(closed(grid, fused, solid), MARGIN, constant_values=1)
    smooth = [gaussian_filter(outside, sigma, mode="nearest") for sigma in SMOOTHING]
    outside = np.minimum(*smooth)
    if outside.min() >= 0:
        raise UserError(f"{run.folder}: the training views show no surface; train it longer")
    vertices, faces, _, _ = marching_cubes(outside, 0, gradient_direction="ascent")
    faces = _large_parts(faces, len(vertices))
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used] - MARGIN, faces.reshape(-1, 3).astype(np.int32)
    near, scatter = (
        map_coordinates(gaussian_filter(field, 1), vertices.T, order=1, mode="nearest")
        for field in (fused.near, fused.scatter)
    )
    shown = near >= SEEN
    vertices = fair(vertices, faces, np.where(shown, HELD / (1 + (scatter / SCATTER) ** 4), UNSEEN))
    positions = np.asarray(grid.origin) + grid.voxel_size * vertices[:, ::-1]
    faces = faces[inside(positions, box)[faces].all(1)]
    if not len(faces):
        raise UserError(
            f"--box: holds no whole face of the mesh, whose sides are about {grid.voxel_size:.3g};"
            " make it larger"
        )
    used, faces = np.unique(faces, return_inverse=True)
    return Surface(positions[used], faces.reshape(-1, 3).astype(np.int32), shown[used])


def fair(vertices: np.ndarray, faces: np.ndarray, held: np.ndarray) -> np.ndarray:
    """(V, 3) float64: vertices moved to minimise the sum of held (V,) times their squared moves,
    plus their squared distances from the mean of their neighbours. faces: (F, 3).
    """
    n = len(vertices)
    ends = np.concatenate([faces[:, :2], faces[:, 1:], faces[:, [2, 0]]])
    beside = csr_array(coo_array((np.ones(len(ends)), ends.T), shape=(n, n)))
    beside = ((beside + beside.T) > 0).astype(np.float64)
    uneven = diags_array(np.ones(n)) - diags_array(1 / beside.sum(1)) @ beside
    matrix = csr_array(uneven.T @ uneven + diags_array(held))
    middle = vertices.mean(0, dtype=np.float64)
    inverse, near = diags_array(1 / matrix.diagonal()), vertices - middle
    columns = [
        cg(matrix, held * column, x0=column, M=inverse, rtol=1e-5, maxiter=STEPS)[0]
        for column in near.T
    ]
    return np.stack(columns, 1) + middle


def seen_first(faces: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, int]:
    """(faces (F, 3), those with at least two seen corners first, and the number of these). seen:
    (V,) bool of the vertices.
    """
    is_seen = seen[faces].sum(1) >= 2
    return faces[np.argsort(~is_seen, kind="stable")], int(is_seen.sum())


def _large_parts(faces, vertices):
    """The faces (F, 3) of parts not tiny beside the largest; warns of how many others there are."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(vertices, vertices))
    _, part = connected_components(graph, directed=False)
    sizes = np.bincount(part[faces[:, 0]])
    is_large = sizes >= LOOSE * sizes.max()
    if crumbs := np.count_nonzero(sizes[~is_large]):
        message = f"the surface: {crumbs} loose parts are left out, {sizes[~is_large].sum()} faces"
        warnings.warn(f"{message} of {len(faces)}", stacklevel=3)
    return faces[is_large[part[faces[:, 0]]]]


def coloured_mesh(run: Run, box: np.ndarray | None = None) -> Mesh:
    """surface(), coloured by the nearest points' mean, by weight over squared distance."""
    geometry, points = surface(run, box), coloured_points(run)
    faces, seen_count = seen_first(geometry.faces, geometry.seen)
    vertices = in_world(geometry.vertices, run.model.grid.voxel_size)
    count = min(NEIGHBOURS, len(points.rows))
    distance, near = cKDTree(points.positions).query(vertices, list(range(1, count + 1)))
    weight = points.weight[near] / (distance**2 + run.model.grid.voxel_size**2)
    mean = (weight[..., None] * points.colours[near]).sum(1) / weight.sum(1, keepdims=True)
    return Mesh(vertices, faces, np.rint(mean).astype(np.uint8), seen_count)


def write_mesh(path: Path | str, mesh: Mesh) -> None:
    """Write a PLY, GLB, OBJ or STL file, by the suffix; all but STL state how many faces are seen.
    Raises UserError as atomic_file does.
    """
    suffix = Path(path).suffix.lower()
    if suffix in (".obj", ".stl"):
        solid = trimesh.Trimesh(
            mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False
        )
        about = {"header": of_faces(mesh.seen)} if suffix == ".obj" else {}
        data: Any = solid.export(file_type=suffix[1:], **about)
        with atomic_file(Path(path)) as file:
            file.write(data.encode() if isinstance(data, str) else data)
    elif suffix == ".glb":
        near = mesh.vertices - mesh.vertices.mean(0)
        normals = trimesh.Trimesh(near, mesh.faces, process=False).vertex_normals  # else flat
        attributes = {
            "POSITION": mesh.vertices,
            "NORMAL": normals.astype(np.float32),
            "COLOR_0": gltf_colours(mesh.colours / 255),
        }
        write_glb(path, attributes, faces=mesh.faces, extras={SEEN_FACES: mesh.seen})
    else:
        columns = place_and_colour(mesh.vertices, mesh.colours)
        write_vertices(path, columns, mesh.faces, comments=[of_faces(mesh.seen)])


def of_faces(seen: int) -> str:
    """The note in a file that says which of its faces are seen: the first ones."""
    return f"{SEEN_FACES} {seen}: the faces after these are shown by no photograph, but guessed"
