"""Two sparse points as COLMAP and nerfstudio write them, and a scene's edits."""

import json
import struct

import numpy as np
from plyfile import PlyData, PlyElement

from pp_cl.scene.edits import Edits, write_edits

POINTS = np.array([[0.5, -1, 2], [3, 4, 5.25]])
COLOURS = np.array([[1, 2, 3], [250, 128, 0]])


def write_model(folder, *, binary):
    """Write a COLMAP model with the points."""
    folder.mkdir(parents=True)
    for name in ("cameras", "images"):
        (folder / f"{name}{'.bin' if binary else '.txt'}").touch()
    rows = list(enumerate(np.hstack([POINTS, COLOURS]).tolist()))
    if not binary:
        lines = (f"{i} {x} {y} {z} {r} {g} {b} 0.5 1 0 2 3" for i, (x, y, z, r, g, b) in rows)
        (folder / "points3D.txt").write_text("# comment\n" + "\n".join(lines) + "\n")
        return
    data = struct.pack("<Q", len(POINTS))
    for i, (x, y, z, r, g, b) in rows:
        data += struct.pack("<QdddBBBdQ", i, x, y, z, int(r), int(g), int(b), 0.5, i + 1)
        data += bytes(8 * (i + 1))
    (folder / "points3D.bin").write_bytes(data)


def write_ply(folder):
    """Write the points as sparse_pc.ply, and a transforms.json that names it."""
    names = ("x", "y", "z", "red", "green", "blue")
    kinds = np.dtype([(name, "f4" if name in "xyz" else "u1") for name in names])
    table = np.array([(*p, *c) for p, c in zip(POINTS, COLOURS, strict=True)], kinds)
    PlyData([PlyElement.describe(table, "vertex")]).write(folder / "sparse_pc.ply")
    (folder / "transforms.json").write_text(json.dumps({"ply_file_path": "sparse_pc.ply"}))


def write_some_edits(folder):
    """Write a pp_cl.json with a box and a dropped image."""
    write_edits(folder, Edits(np.array([[-1.0, -1, -1], [1, 2, 3]]), frozenset({"r_1.png"})))
