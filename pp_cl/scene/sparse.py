"""Reads the sparse points of a scene: COLMAP's, or the .ply that transforms.json names."""

import os
from itertools import islice
from pathlib import Path

import numpy as np
from plyfile import PlyData

from pp_cl.errors import UserError
from pp_cl.files.untrusted import opened_regular, refusal
from pp_cl.scene.lookup import find_image
from pp_cl.scene.readers import colmap, transforms
from pp_cl.scene.readers.common import MOST, fail_at, numbers, read_json

MOST_POINTS = 2**20  # later points are not read
MOST_PLY = 2**28  # bytes
COLOURS = ("red", "green", "blue")
GREY = 150  # colour of points that have none


def sparse_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """((N, 3) float64 world positions, (N, 3) uint8 colours); N may be 0. Raises UserError naming a
    broken file.
    """
    shared = {}
    if (file := folder / transforms.SINGLE).is_file():
        shared = read_json(file)
        named = str(shared.get("ply_file_path") or "") if isinstance(shared, dict) else ""
        if os.path.isfile(folder / named):
            return _read_ply(folder / find_image(folder, named, fail_at(file)))
    model = colmap.model_folder(folder)
    rows = colmap.read_points(model) if model else ()
    table = np.array(list(islice(rows, MOST_POINTS)), np.float64).reshape(-1, 6)
    if not (np.abs(table) < MOST).all():
        raise UserError(f"{model}: its points3D hold NaN, Inf or a huge number; copy it again")
    points = table[:, :3]
    if isinstance(shared, dict) and (stated := shared.get("applied_transform")):
        # from COLMAP's world to that of nerfstudio's frames
        matrix = numbers(stated[:3] if isinstance(stated, list) else stated, (3, 4))
        if matrix is None:
            raise fail_at(file, "applied_transform")("must be 3 rows of 4 numbers; correct it")
        points = points @ matrix[:, :3].T + matrix[:, 3]
    return points, np.clip(table[:, 3:], 0, 255).astype(np.uint8)


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
    except Exception as error:  # plyfile raises all kinds of exceptions on broken bytes
        raise refusal(file, error, "points of a .ply") from None
    if not (np.abs(points) < MOST).all():
        raise UserError(f"{file}: holds NaN, Inf or a huge number; write it again")
    return points, np.clip(colours, 0, 255).astype(np.uint8)
