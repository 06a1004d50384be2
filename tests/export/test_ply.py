"""The PLY file holds the very values that went in."""

import numpy as np
import plyfile
import pytest
import trimesh

from pp_cl.export.ply import write_ply
from pp_cl.export.points import coloured_points


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """(file, points)."""
    path, points = tmp_path_factory.mktemp("ply") / "a.ply", coloured_points(run, min_weight=0.05)
    write_ply(path, points, run.model.cloud)
    return path, points


def test_it_reads_back_by_plyfile(run, written):
    path, points = written
    data = plyfile.PlyData.read(str(path))
    vertex = data["vertex"]
    assert not data.text and data.byte_order == "<" and len(vertex) == len(points.rows)
    for axis, name in enumerate(("x", "y", "z")):
        assert vertex[name].dtype == "f4" and (vertex[name] == points.positions[:, axis]).all()
    for channel, name in enumerate(("red", "green", "blue")):
        assert vertex[name].dtype == "u1" and (vertex[name] == points.colours[:, channel]).all()
    assert (vertex["opacity"] == points.opacity).all()
    assert (vertex["weight"] == points.weight).all()
    stored = run.model.cloud.arrays(run.dev)
    by_degree = [stored[f"points.sh{degree}"].get()[points.rows] for degree in range(3)]
    for c in range(16):
        for degree in (0, 1, 2):
            for k in range(2 * degree + 1):
                assert (vertex[f"feature_{c}_{degree}_{k}"] == by_degree[degree][:, k, c]).all()
    assert len(vertex.properties) == 8 + 9 * 16


def test_the_header_explains_every_kind_of_property(written):
    comments = " ".join(plyfile.PlyData.read(str(written[0])).comments)
    for name in ("red, green, blue:", "weight:", "opacity:", "feature_C_D_K:"):
        assert name in comments


def test_it_reads_back_by_trimesh(written):
    path, points = written
    cloud = trimesh.load(path)
    assert np.array_equal(np.float32(cloud.vertices), points.positions)
    assert np.array_equal(cloud.colors[:, :3], points.colours)
