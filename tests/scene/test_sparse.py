"""Sparse points that scenes bring along."""

import json
import struct

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from pp_cl.errors import UserError
from pp_cl.scene.sparse import sparse_points

POINTS = np.array([[0.5, -1, 2], [3, 4, 5.25]])
COLOURS = np.array([[1, 2, 3], [250, 128, 0]])


def write_model(folder, binary):
    """A model of COLMAP with the points."""
    folder.mkdir(parents=True)
    for name in ("cameras", "images"):
        (folder / f"{name}{'.bin' if binary else '.txt'}").touch()
    if not binary:
        rows = (f"{i} {x} {y} {z} {r} {g} {b} 0.5 1 0 2 3" for i, (x, y, z, r, g, b) in rows_())
        (folder / "points3D.txt").write_text("# comment\n" + "\n".join(rows) + "\n")
        return
    data = struct.pack("<Q", len(POINTS))
    for i, (x, y, z, r, g, b) in rows_():
        data += struct.pack("<QdddBBBdQ", i, x, y, z, int(r), int(g), int(b), 0.5, i + 1)
        data += bytes(8 * (i + 1))
    (folder / "points3D.bin").write_bytes(data)


def rows_():
    return enumerate(np.hstack([POINTS, COLOURS]).tolist())


@pytest.mark.parametrize("binary", [True, False])
def test_points_of_colmap(tmp_path, binary):
    write_model(tmp_path / "sparse" / "0", binary)
    points, colours = sparse_points(tmp_path)
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(colours, COLOURS)
    shared = {"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 10]], "frames": []}
    (tmp_path / "transforms.json").write_text(json.dumps(shared))
    np.testing.assert_array_equal(
        sparse_points(tmp_path)[0], POINTS[:, [1, 0, 2]] * [1, 1, -1] + [0, 0, 10]
    )


def test_points_of_nerfstudio(tmp_path):
    names = ("x", "y", "z", "red", "green", "blue")
    kinds = np.dtype([(name, "f4" if name in "xyz" else "u1") for name in names])
    table = np.array([(*p, *c) for p, c in zip(POINTS, COLOURS, strict=True)], kinds)
    PlyData([PlyElement.describe(table, "vertex")]).write(tmp_path / "sparse_pc.ply")
    (tmp_path / "transforms.json").write_text(json.dumps({"ply_file_path": "sparse_pc.ply"}))
    points, colours = sparse_points(tmp_path)
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(colours, COLOURS)
    data = (tmp_path / "sparse_pc.ply").read_bytes()
    (tmp_path / "sparse_pc.ply").write_bytes(data[:-3])
    with pytest.raises(UserError, match=r"sparse_pc\.ply"):
        sparse_points(tmp_path)
    (tmp_path / "transforms.json").write_text(json.dumps({"ply_file_path": "../a.ply"}))
    with pytest.raises(UserError, match=r"transforms\.json"):
        sparse_points(tmp_path)


def test_no_points_and_broken_ones(tmp_path):
    assert [len(part) for part in sparse_points(tmp_path)] == [0, 0]
    for text in ("1 2 3\n", "1 x 0 0 0 0 0\n", "1 nan 0 0 0 0 0 0\n"):
        folder = tmp_path / str(len(text))
        write_model(folder / "sparse", False)
        (folder / "sparse" / "points3D.txt").write_text(text)
        with pytest.raises(UserError, match="points3D"):
            sparse_points(folder)
    write_model(tmp_path / "cut" / "sparse", True)
    file = tmp_path / "cut" / "sparse" / "points3D.bin"
    file.write_bytes(file.read_bytes()[:-30])
    with pytest.raises(UserError, match=r"points3D\.bin"):
        sparse_points(tmp_path / "cut")
