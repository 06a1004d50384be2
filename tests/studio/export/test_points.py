import numpy as np
import plyfile
import pytest

from pp_cl.engine.stored import cloud_arrays
from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.files.srgb import linear_to_srgb
from pp_studio.export.gltf import gltf_colours
from pp_studio.export.harmonics import observe
from pp_studio.export.points import coloured_points, write_ply


def test_colours_are_those_of_the_best_view(run):
    points, cameras = coloured_points(run), run.cameras("train")
    weights = np.stack([observation.point_weights() for observation in observe(run, cameras, "")])
    images = [to_8bit(run.render(camera).rgba()[..., :3]) for camera in cameras]
    positions = run.model.positions()
    assert points.rows.tolist() == np.flatnonzero(weights.max(0) > 0).tolist()
    for row, colour in list(zip(points.rows, points.colours, strict=True))[::40]:
        best = weights[:, row].argmax()
        camera = cameras[best]
        x, y, z = camera.pose[:, :3].T @ (positions[row] - camera.eye)
        column = min(max(int(camera.fx * x / z + camera.cx), 0), 29)
        line = min(max(int(camera.fy * y / z + camera.cy), 0), 29)
        assert colour.tolist() == images[best][line, column].tolist()
    assert points.weight == pytest.approx(weights.max(0)[points.rows])
    assert points.positions == pytest.approx(positions[points.rows], abs=1e-6)
    assert (points.opacity == run.model.cloud.opacity.get()[points.rows, 0]).all()


def test_no_points_are_one_line(run):
    with pytest.raises(UserError, match="--min-weight 1000: no point weighs more"):
        coloured_points(run, min_weight=1000)


def test_the_ply_reads_back_by_plyfile(run, tmp_path):
    path, points = tmp_path / "a.ply", coloured_points(run, min_weight=0.05)
    write_ply(path, points, run.model.cloud)
    data = plyfile.PlyData.read(str(path))
    vertex = data["vertex"]
    assert not data.text and data.byte_order == "<" and len(vertex) == len(points.rows)
    for axis, name in enumerate(("x", "y", "z")):
        assert vertex[name].dtype == "f4" and (vertex[name] == points.positions[:, axis]).all()
    for channel, name in enumerate(("red", "green", "blue")):
        assert vertex[name].dtype == "u1" and (vertex[name] == points.colours[:, channel]).all()
    assert (vertex["point_opacity"] == points.opacity).all()
    assert (vertex["weight"] == points.weight).all()
    offset = run.model.cloud.offset.get()[points.rows, 3]
    spacings = vertex["radius"] / run.model.grid.voxel_size / run.config.raster.radius
    assert np.log(spacings) == pytest.approx(offset, abs=1e-5)
    stored = cloud_arrays(run.dev, run.model.cloud)
    by_degree = [stored[f"points.sh{degree}"].get()[points.rows] for degree in range(3)]
    for c in range(16):
        for degree in (0, 1, 2):
            for k in range(2 * degree + 1):
                assert (vertex[f"feature_{c}_{degree}_{k}"] == by_degree[degree][:, k, c]).all()
    assert len(vertex.properties) == 9 + 9 * 16
    comments = " ".join(data.comments)
    for name in ("red, green, blue:", "weight:", "point_opacity:", "radius:", "feature_C_D_K:"):
        assert name in comments


def test_no_level_of_a_dark_colour_is_lost():
    levels = np.arange(256)
    stored = gltf_colours(np.repeat(levels[:, None] / 255, 3, axis=1))
    read = 255 * linear_to_srgb(stored[:, :3] / 65535)
    assert np.array_equal(np.rint(read), np.repeat(levels[:, None], 3, axis=1))
    assert gltf_colours(np.array([[-0.1, 1.1, 0.0]])).tolist() == [[0, 65535, 0, 65535]]
