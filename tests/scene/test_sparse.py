import json

import numpy as np
import pytest
from support.sparse import COLOURS, POINTS, write_model, write_ply

from pp_cl.errors import UserError
from pp_cl.scene.sparse import sparse_points


@pytest.mark.parametrize("binary", [True, False])
def test_points_of_colmap(tmp_path, binary):
    write_model(tmp_path / "sparse" / "0", binary=binary)
    points, colours = sparse_points(tmp_path)
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(colours, COLOURS)
    shared = {"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 10]], "frames": []}
    (tmp_path / "transforms.json").write_text(json.dumps(shared))
    np.testing.assert_array_equal(
        sparse_points(tmp_path)[0], POINTS[:, [1, 0, 2]] * [1, 1, -1] + [0, 0, 10]
    )


def test_points_of_nerfstudio(tmp_path):
    write_ply(tmp_path)
    points, colours = sparse_points(tmp_path)
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(colours, COLOURS)
    data = (tmp_path / "sparse_pc.ply").read_bytes()
    (tmp_path / "sparse_pc.ply").write_bytes(data[:-3])
    with pytest.raises(UserError, match=r"sparse_pc\.ply"):
        sparse_points(tmp_path)
    (tmp_path / "sparse_pc.ply").rename(tmp_path.parent / "a.ply")
    assert not len(sparse_points(tmp_path)[0]), "what is drawn beside the cameras is no need"
    (tmp_path / "transforms.json").write_text(json.dumps({"ply_file_path": "../a.ply"}))
    with pytest.raises(UserError, match=r"transforms\.json"):
        sparse_points(tmp_path)


def test_no_points_and_broken_ones(tmp_path):
    assert [len(part) for part in sparse_points(tmp_path)] == [0, 0]
    for name, data in (("txt", b"1 nan 0 0 0 0 0 0\n"), ("bin", b"\2" + bytes(30))):
        write_model(tmp_path / name / "sparse", binary=name == "bin")
        (tmp_path / name / "sparse" / f"points3D.{name}").write_bytes(data)
        with pytest.raises(UserError, match="points3D"):
            sparse_points(tmp_path / name)
