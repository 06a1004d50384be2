"""The GLB file of points."""

import numpy as np
import trimesh

from pp_cl.export.glb import gltf_colours, write_point_glb
from pp_cl.export.points import coloured_points


def test_it_reads_back_by_trimesh(run, tmp_path):
    points = coloured_points(run)
    write_point_glb(tmp_path / "a.glb", points)
    (cloud,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    assert isinstance(cloud, trimesh.PointCloud)
    assert np.array_equal(np.float32(cloud.vertices), points.positions)
    assert np.array_equal(cloud.colors, gltf_colours(points.colours))


def test_colours_are_in_linear_light():
    srgb = np.repeat(np.uint8([[0], [10], [128], [255]]), 3, axis=1)
    # IEC 61966-2-1: 10 is on its straight part
    expected = [0, round(10 / 12.92), round(255 * ((128 / 255 + 0.055) / 1.055) ** 2.4), 255]
    assert gltf_colours(srgb)[:, 0].tolist() == expected
    assert (gltf_colours(srgb)[:, 3] == 255).all()
