"""Makes the surface of a run as a mesh of few faces with a texture, baked from the run's own
renderings of its training views.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.ndimage import (
    distance_transform_edt,
    map_coordinates,
    maximum_filter,
    minimum_filter,
)
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from trimesh.exchange.obj import export_obj
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from pp_cl import Progress, Run, track
from pp_cl.errors import UserError, require
from pp_cl.files import atomic_file, to_8bit, write_png, write_text
from pp_studio.export.fusion import COVERED, TRUNCATION
from pp_studio.export.gltf import make_unlit
from pp_studio.export.mesh import SEEN_FACES, of_faces, seen_first, surface

FACES = 60_000  # at most; marching cubes make more for the same surface
SIDE = 2048  # texels on each side
HIDDEN = 1.5  # a texel is hidden this many voxel sizes behind what a view shows
LEAST_COSINE = 0.2  # least cosine between a texel's normal and the direction to an eye that sees it
SHARPNESS = 3  # power of that cosine in a view's weight, which is squared where colours agree
VIEWS = 16  # at most this many views, those of the largest weights, decide a texel's colour
AT_EDGES = 0.05  # factor of a view's weight where its depths jump: neighbours show something else
# Share of the views' weight that is darker than the chosen colour: half would be the median, but
# highlights, which move with the eye, add light. How far views may differ from it, in luminance.
DARKER, AGREEING = 0.4, 0.08
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
# Unseen texels get a mean colour of this many seen ones, weighted by distance^-4: from only a few
# of the nearest, a base would get rays.
SAMPLES = 1024
AT_ONCE = 1 << 13  # texels in a batch


def textured_mesh(run: Run, turn: np.ndarray, box: np.ndarray | None = None) -> trimesh.Trimesh:
    """The surface of the training views' depths, or its part in a box (2, 3), with a texture,
    turned by (3, 3); in scene units. Raises UserError as surface() and require() do.
    """
    require("textured", "xatlas", "fast-simplification")
    import fast_simplification
    import xatlas

    geometry = surface(run, box)
    middle, faces = geometry.vertices.mean(0), geometry.faces
    whole = vertices = (geometry.vertices - middle).astype(np.float32)
    if len(faces) > FACES:
        with Progress("simplifying the surface"):
            vertices, faces = fast_simplification.simplify(vertices, faces, target_count=FACES)
    faces, seen_count = seen_first(faces, geometry.seen[cKDTree(whole).query(vertices)[1]])
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
        metadata={SEEN_FACES: seen_count},
        process=False,
    )


def texels(
    uv: np.ndarray, faces: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(rows, columns, faces (T,), shares (T, 3) of corners) of the texels with centres in a face of
    a square texture, which is upside down as in glTF. uv: (V, 2) in [0, 1]. faces: (F, 3).
    """
    corners = np.stack([uv[:, 0], 1 - uv[:, 1]], 1)[faces].astype(np.float64) * side - 0.5
    first = np.ceil(corners.min(1)).astype(int)
    width, height = (np.floor(corners.max(1)).astype(int) - first + 1).T
    a, b, c = corners.transpose(1, 0, 2)
    area = _cross(b - a, c - a)
    pieces = []
    # faces with boxes of similar sizes go together: each texel of a box is tested for all of them
    order = np.argsort(np.maximum(width, height))
    for group in np.array_split(order, max(1, len(faces) // 4096)):
        columns, rows = width[group].max(initial=0), height[group].max(initial=0)
        for y in range(max(0, rows)):
            for x in range(max(0, columns)):
                tested = group[(x < width[group]) & (y < height[group]) & (area[group] != 0)]
                at = first[tested] + (x, y)
                toward_b = _cross(at - a[tested], c[tested] - a[tested]) / area[tested]
                toward_c = _cross(b[tested] - a[tested], at - a[tested]) / area[tested]
                shares = np.stack([1 - toward_b - toward_c, toward_b, toward_c], 1)
                inside = (shares >= -1e-9).all(1) & (at >= 0).all(1) & (at < side).all(1)
                pieces.append((at[inside, 1], at[inside, 0], tested[inside], shares[inside]))
    rows, columns, chosen, shares = (np.concatenate(part) for part in zip(*pieces, strict=True))
    return rows, columns, chosen, shares


def _cross(u, v):
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def bake(run: Run, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(T, 3) sRGB colours of texels: what most of the training views that look at them directly
    show, without highlights. positions, normals: (T, 3), world. Texels that no view sees get the
    colours of others, mostly the nearest. Raises UserError if no view sees any.
    """
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    cameras, n = run.cameras("train"), len(positions)
    kept = min(VIEWS, len(cameras))
    weights, colours = np.zeros((n, kept), np.float32), np.zeros((n, kept, 3), np.uint8)
    for camera in track(cameras, "texture", "view"):
        rows, weight, colour = _looked_at(run, camera, positions, normals)
        least = weights[rows].argmin(1)
        better = weight > weights[rows, least]
        rows, least = rows[better], least[better]
        weights[rows, least], colours[rows, least] = weight[better], colour[better]
    baked = np.zeros((n, 3))
    for first in range(0, n, AT_ONCE):
        chunk = slice(first, first + AT_ONCE)
        baked[chunk] = agreed(weights[chunk], colours[chunk] / np.float32(255))
    is_seen = weights.any(1)
    if not is_seen.any():
        raise UserError(f"{run.folder}: no training view shows its surface; train it longer")
    rows = np.flatnonzero(is_seen)
    rows = np.random.default_rng(0).choice(rows, min(SAMPLES, len(rows)), replace=False)
    unseen = np.flatnonzero(~is_seen)
    for part in np.array_split(unseen, len(unseen) // AT_ONCE + 1):
        share = 1 / (cdist(positions[part], positions[rows]) + run.model.grid.voxel_size) ** 4
        baked[part] = share @ baked[rows] / share.sum(1, keepdims=True)
    return baked


def _looked_at(run, camera, positions, normals):
    """((S,) texels that a view sees, (S,) its weights by how directly it looks at them, (S, 3)
    uint8 sRGB that it shows there).
    """
    rendered, voxel_size = run.render(camera), run.model.grid.voxel_size
    solid = rendered.alpha >= COVERED
    depth = np.where(solid, rendered.median_depth, 2 * rendered.median_depth[solid].max(initial=0))
    jump = maximum_filter(depth, 3) - minimum_filter(depth, 3) > TRUNCATION * voxel_size
    towards = camera.eye - positions
    cosine = np.einsum("nc,nc->n", normals, towards)
    cosine /= np.sqrt(np.einsum("nc,nc->n", towards, towards))
    rows = np.flatnonzero(cosine > LEAST_COSINE)
    column, row, shown = camera.pixels(positions[rows])
    x, y, z = camera.project(positions[rows])
    rows_seen = shown & solid[row, column] & (z < depth[row, column] + HIDDEN * voxel_size)
    rows, row, column = rows[rows_seen], row[rows_seen], column[rows_seen]
    # rendered over black, as straight colours beside the object are noise
    layers = *np.moveaxis(rendered.over((0.0, 0.0, 0.0)), 2, 0), rendered.alpha
    place = np.stack([y, x])[:, rows_seen] - 0.5
    *channels, alpha = (map_coordinates(layer, place, order=1, mode="nearest") for layer in layers)
    colours = to_8bit(np.stack(channels, 1) / np.maximum(alpha, 1 / 255)[:, None])
    weight = cosine[rows] ** SHARPNESS * np.where(jump[row, column], AT_EDGES, 1)
    return rows, weight.astype(np.float32), colours


def agreed(weights: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """(T, 3): for each texel, the mean of those of K views' colours (T, K, 3) that are about as
    light as the one at DARKER of the weight (T, K), counted from the darkest; 0 without weight.
    """
    light = colours @ LUMINANCE
    order = np.argsort(light, axis=1)
    below = np.cumsum(np.take_along_axis(weights, order, 1), axis=1)
    at = (below >= DARKER * below[:, -1:]).argmax(1)[:, None]
    middle = np.take_along_axis(light, np.take_along_axis(order, at, 1), 1)
    share = np.where(np.abs(light - middle) <= AGREEING, weights**2, 0)[..., None]
    return (share * colours).sum(1) / np.maximum(share.sum(1), 1e-12)


def write_textured(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write an unlit GLB, with float32 positions relative to the middle, to which its node moves
    them; or an OBJ with companions(). Raises UserError as atomic_file does.
    """
    if path.suffix.lower() == ".obj":
        _write_obj(path, mesh)
        return
    middle = np.rint(mesh.vertices.mean(0))
    near, scene = mesh.copy(), trimesh.Scene()
    near.apply_translation(-middle)
    scene.add_geometry(near, transform=trimesh.transformations.translation_matrix(middle))
    data: Any = scene.export(file_type="glb", include_normals=True, tree_postprocessor=make_unlit)
    with atomic_file(path) as file:
        file.write(data)


def companions(path: Path) -> list[Path]:
    """The files that a textured OBJ needs beside it: its materials and their texture. Their names
    have no spaces, at which other programs end a name.
    """
    stem = "_".join(path.stem.split())
    return [path.with_name(f"{stem}.mtl"), path.with_name(f"{stem}.png")]


def is_textured(path: Path) -> bool:
    """Whether an OBJ and its materials are there, as export_texture() writes them."""
    materials, texture = companions(path)
    with suppress(OSError, UnicodeDecodeError):
        return path.exists() and materials.read_text("utf-8") == _materials(texture)
    return False


def _materials(texture):
    return f"newmtl {texture.stem}\nillum 0\nKd 1 1 1\nmap_Kd {texture.name}\n"


def _write_obj(path, mesh):
    materials, texture = companions(path)
    image = mesh.visual.material.baseColorTexture
    write_png(texture, np.asarray(image) / np.float32(255))
    write_text(materials, _materials(texture))
    near = mesh.copy()
    near.visual.material = SimpleMaterial(image=image, name=texture.stem)
    text, _ = export_obj(
        near,
        include_normals=True,
        return_texture=True,
        mtl_name=materials.name,
        header=of_faces(mesh.metadata[SEEN_FACES]),
    )
    write_text(path, text)
