"""The sparse points that a scene brings along: COLMAP's model, or the .ply that transforms.json
names.
"""

import os
from pathlib import Path

import numpy as np
from plyfile import PlyData

from pp_cl.errors import UserError
from pp_cl.files.untrusted import opened_regular, refusal
from pp_cl.scene.readers import colmap, transforms
from pp_cl.scene.readers.common import MOST, fail_at, read_json
from pp_cl.scene.readers.found import find_image

MOST_POINTS = 2**20  # that are read
MOST_PLY = 2**28  # bytes
COLOURS = ("red", "green", "blue")
GREY = 150  # of points without colour


def sparse_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """((N, 3) float64 world positions, (N, 3) uint8 colours), none where the scene has none, or not
    the file that it names. Raises UserError naming a file that is broken.
    """
    shared = {}
    if (file := folder / transforms.SINGLE).is_file():
        shared = read_json(file)
        named = str(shared.get("ply_file_path") or "") if isinstance(shared, dict) else ""
        if os.path.isfile(folder / named):
            return _read_ply(folder / find_image(folder, named, fail_at(file)))
    model = colmap.model_folder(folder)
    if model is None:
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    points, colours = _read_model(model)
    if isinstance(shared, dict) and shared.get("applied_transform"):
        points = points @ _applied(shared["applied_transform"], file)
    return points[:, :3], colours


def _applied(rows, file):
    """(4, 3): from COLMAP's world, (x, y, z, 1), to that of nerfstudio's frames."""
    try:
        matrix = np.array(rows, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not (np.abs(matrix) < MOST).all():
        raise fail_at(file, "applied_transform")("must be 3 rows of 4 numbers; correct it")
    return matrix[:3].T


def _read_model(folder):
    """((N, 4) positions with 1 added, (N, 3) colours) of points3D.bin or points3D.txt."""
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    rows = []
    if binary.is_file():
        rows = _bounded(colmap.binary_points(binary))
    elif text.is_file():
        rows = _bounded(colmap.text_points(text))
    table = np.array(rows, np.float64).reshape(-1, 6)
    if not (np.abs(table) < MOST).all():
        raise UserError(f"{folder}: its points3D hold NaN, Inf or a huge number; copy it again")
    return np.pad(table[:, :3], ((0, 0), (0, 1)), constant_values=1), _bytes(table[:, 3:])


def _bounded(rows):
    return [row for _, row in zip(range(MOST_POINTS), rows, strict=False)]


def _bytes(colours):
    return np.clip(colours, 0, 255).astype(np.uint8)


def _read_ply(file):
    try:
        with opened_regular(file) as opened:
            if os.fstat(opened.fileno()).st_size > MOST_PLY:
                raise ValueError(f"larger than {MOST_PLY} bytes")
            vertices = PlyData.read(opened)["vertex"].data[:MOST_POINTS]
        points = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
        colours = np.full((len(points), 3), GREY)
        if set(COLOURS) <= set(vertices.dtype.names):
            colours = np.stack([vertices[name] for name in COLOURS], axis=1)
    except Exception as error:  # plyfile meets broken bytes with whatever comes up
        raise refusal(file, error, "points of a .ply") from None
    if not (np.abs(points) < MOST).all():
        raise UserError(f"{file}: holds NaN, Inf or a huge number; write it again")
    return points, _bytes(colours)
