"""The surface of a run as a mesh of few faces with a texture, which is baked from the run's own
renderings of its training views.
"""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.ndimage import distance_transform_edt, map_coordinates
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from pp_cl import Progress, Run, track
from pp_cl.errors import require
from pp_cl.files import atomic_file, to_8bit
from pp_studio.export.gltf import make_unlit
from pp_studio.export.mesh import COVERED, surface

FACES = 60_000  # at most: marching cubes make more of the same surface
SIDE = 2048  # texels
HIDDEN = 1.5  # voxel sizes behind what a view shows: a texel there is hidden
LEAST_COSINE = 0.2  # between a texel's normal and the direction to an eye that sees it
SHARPNESS = 6  # power of that cosine in a view's weight: the best views make up most of a colour


def textured_mesh(run: Run, turn: np.ndarray, box: np.ndarray | None = None) -> trimesh.Trimesh:
    """The surface of the training views' depths, of which a box (2, 3) may hold a part, turned by
    (3, 3); in scene units. Raises UserError as surface() and require() do.
    """
    require("textured", "xatlas", "fast-simplification")
    import fast_simplification
    import xatlas

    vertices, faces = surface(run, box)
    middle = vertices.mean(0, dtype=np.float64)
    vertices = (vertices - middle).astype(np.float32)
    if len(faces) > FACES:
        with Progress("simplifying the surface"):
            vertices, faces = fast_simplification.simplify(vertices, faces, target_count=FACES)
    solid = trimesh.Trimesh(vertices, faces, process=False)
    normals = solid.vertex_normals.astype(np.float32)
    with Progress("unwrapping the surface"):
        rows, faces, uv = xatlas.parametrize(vertices, faces)
    vertices, normals, faces = vertices[rows], normals[rows], faces.astype(np.int64)
    row, column, face, shares = texels(uv, faces, SIDE)

    def between(values):
        return np.einsum("nk,nkc->nc", shares, values[faces[face]])

    colours = bake(run, between(vertices) + middle, between(normals))
    image = np.zeros((SIDE, SIDE, 3), np.uint8)
    image[row, column] = to_8bit(colours)
    known = np.zeros((SIDE, SIDE), bool)
    known[row, column] = True
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(image[tuple(nearest)]),
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    return trimesh.Trimesh(
        (vertices + middle) @ turn.T,
        faces,
        vertex_normals=normals @ turn.T,
        visual=TextureVisuals(uv, material=material),
        process=False,
    )


def texels(
    uv: np.ndarray, faces: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(rows, columns, faces (T,), shares (T, 3) of their corners) of the texels whose centres lie
    in a face of a square texture, upside down as glTF's are. uv: (V, 2) in [0, 1]. faces: (F, 3).
    """
    corners = np.stack([uv[:, 0], 1 - uv[:, 1]], 1)[faces].astype(np.float64) * side - 0.5
    first = np.ceil(corners.min(1)).astype(int)
    width, height = (np.floor(corners.max(1)).astype(int) - first + 1).T
    a, b, c = corners.transpose(1, 0, 2)
    area = _cross(b - a, c - a)
    found = []
    # faces of boxes of similar sizes together, each texel of the box for all of them
    order = np.argsort(np.maximum(width, height))
    for group in np.array_split(order, max(1, len(faces) // 4096)):
        columns, rows = width[group].max(initial=0), height[group].max(initial=0)
        for y in range(max(0, rows)):
            for x in range(max(0, columns)):
                some = group[(x < width[group]) & (y < height[group]) & (area[group] != 0)]
                at = first[some] + (x, y)
                toward_b = _cross(at - a[some], c[some] - a[some]) / area[some]
                toward_c = _cross(b[some] - a[some], at - a[some]) / area[some]
                shares = np.stack([1 - toward_b - toward_c, toward_b, toward_c], 1)
                inside = (shares >= -1e-9).all(1) & (at >= 0).all(1) & (at < side).all(1)
                found.append((at[inside, 1], at[inside, 0], some[inside], shares[inside]))
    rows, columns, chosen, shares = (np.concatenate(part) for part in zip(*found, strict=True))
    return rows, columns, chosen, shares


def _cross(u, v):
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def bake(run: Run, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(T, 3) sRGB colours of texels: the mean of what the training views show there, weighted by
    how directly they look; where none does, those of all views weigh the same, hidden or not.
    positions, normals: (T, 3), world.
    """
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    seen, hidden = (np.zeros((len(positions), 4)) for _ in range(2))
    for camera in track(run.cameras("train"), "texture", "view"):
        rendered, (x, y, z) = run.render(camera), camera.project(positions)
        shown = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        place = np.stack([np.where(shown, y, 0.5) - 0.5, np.where(shown, x, 0.5) - 0.5])
        row, column = np.rint(place).astype(int).clip(0, [[camera.height - 1], [camera.width - 1]])
        shown &= rendered.alpha[row, column] >= COVERED
        rgba = rendered.rgba()
        channels = [map_coordinates(rgba[..., c], place, order=1, mode="nearest") for c in range(3)]
        colours = np.stack([*channels, np.ones(len(z))], 1) * shown[:, None]
        towards = camera.eye - positions
        cosine = (normals * towards).sum(1) / np.linalg.norm(towards, axis=1)
        behind = rendered.median_depth[row, column] + HIDDEN * run.model.grid.voxel_size
        direct = shown & (z < behind) & (cosine > LEAST_COSINE)
        seen += np.where(direct, np.maximum(cosine, 0) ** SHARPNESS, 0)[:, None] * colours
        hidden += colours
    total = np.where(seen[:, 3:] > 0, seen, hidden)
    return total[:, :3] / np.maximum(total[:, 3:], 1e-12)


def write_textured(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write a GLB, unlit, whose positions are float32: relative to the middle, to which its node
    moves them. Raises UserError as atomic_file does.
    """
    middle = np.rint(mesh.vertices.mean(0))
    near, scene = mesh.copy(), trimesh.Scene()
    near.apply_translation(-middle)
    scene.add_geometry(near, transform=trimesh.transformations.translation_matrix(middle))
    data: Any = scene.export(file_type="glb", include_normals=True, tree_postprocessor=make_unlit)
    with atomic_file(path) as file:
        file.write(data)
