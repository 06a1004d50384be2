from unittest.mock import ANY

import numpy as np
import plyfile
import pytest
import trimesh
from support.gltf import glb

from pp_cl.errors import UserError
from pp_studio.export import mesh as module
from pp_studio.export.fusion import Fused
from pp_studio.export.gltf import gltf_colours
from pp_studio.export.mesh import coloured_mesh, fair, surface, write_mesh

RADIUS = 0.8  # of the ball


@pytest.fixture(scope="module")
def mesh(run):
    return coloured_mesh(run)


def test_it_is_the_ball(run, mesh):
    distance = np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS)
    assert np.median(distance) < 1.5 * run.model.grid.voxel_size
    made = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert made.is_watertight
    assert made.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.25)  # faces look outwards


def test_vertices_have_the_colours_of_the_ball_there(mesh):
    expected = 255 * (0.5 + 0.4 * np.sin(4 * mesh.vertices + [0, 1, 2]))  # support/scenes.py
    high = mesh.vertices[:, 2] > 0  # the cameras see these well
    assert np.median(np.abs(mesh.colours - expected)[high]) < 30


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj", "stl"])
def test_it_reads_back_by_trimesh(mesh, suffix, tmp_path):
    path = tmp_path / f"a.{suffix}"
    write_mesh(path, mesh)
    read = trimesh.load(path, process=False)
    if suffix == "glb":
        (read,) = read.geometry.values()
        colours = read.visual.vertex_attributes["color"]
        assert np.array_equal(colours, gltf_colours(mesh.colours / 255))
        header, stored = glb(path)
        outwards = read.vertices / np.linalg.norm(read.vertices, axis=1)[:, None]
        assert np.median((stored["NORMAL"] * outwards).sum(1)) > 0.9
        assert header["extensionsUsed"] == ["KHR_materials_unlit"]
        assert header["materials"] == [
            {
                "pbrMetallicRoughness": {"metallicFactor": 0},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ]
    elif suffix == "stl":  # STL has no colours, and a vertex for each corner
        assert np.array_equal(np.float32(read.triangles), mesh.vertices[mesh.faces])
        return
    else:
        assert np.array_equal(read.visual.vertex_colors[:, :3], mesh.colours)
    decimals = {"rtol": 0, "atol": 1e-8 if suffix == "obj" else 0}
    np.testing.assert_allclose(np.float32(read.vertices), mesh.vertices, **decimals)
    assert np.array_equal(read.faces, mesh.faces)


def test_fairing_smooths_noise_and_keeps_what_is_held(rng):
    ball = trimesh.creation.icosphere(4, 10.0)
    noisy = ball.vertices + 0.15 * rng.normal(size=ball.vertices.shape)

    def roughness(vertices):
        return trimesh.Trimesh(vertices, ball.faces).face_adjacency_angles.mean()

    held = np.where(ball.vertices[:, 2] > 0, 1e3, 0.01)
    faired = fair(noisy, ball.faces, held)
    firm = ball.vertices[:, 2] > 1
    assert np.abs(faired - noisy)[firm].max() < 0.02
    away = [np.abs(np.linalg.norm(v, axis=1) - 10)[~firm].mean() for v in (noisy, faired)]
    assert away[1] < 0.7 * away[0]  # smoothing does not shrink the ball
    assert roughness(faired) < 0.75 * roughness(noisy)


def test_what_no_view_shows_comes_last_and_is_said(run, mesh, tmp_path):
    """The cameras look down at the ball, so its lower half comes last."""
    height = mesh.vertices[mesh.faces].mean(1)[:, 2]
    assert len(height) / 2 < mesh.seen < len(height)
    assert height[mesh.seen :].max() < 0 < height[: mesh.seen].max()
    comment = f"seen_faces {mesh.seen}: "
    for suffix in ("ply", "obj", "glb"):
        write_mesh(tmp_path / f"a.{suffix}", mesh)
    assert plyfile.PlyData.read(tmp_path / "a.ply").comments[0].startswith(comment)
    assert (tmp_path / "a.obj").read_text().startswith(f"# {comment}")
    assert glb(tmp_path / "a.glb")[0]["meshes"] == [
        {"primitives": ANY, "extras": {"seen_faces": mesh.seen}}
    ]


def test_no_surface_is_one_line(run, monkeypatch):
    def nothing(grid, _):
        return Fused(*np.ones((3, *grid.dims[::-1]), np.float32))

    monkeypatch.setattr(module, "fuse", nothing)
    with pytest.raises(UserError, match="show no surface"):
        surface(run)


def test_crumbs_are_left_out_and_said(run, monkeypatch):
    fuse = module.fuse

    def with_a_crumb(grid, views):
        fused = fuse(grid, views)
        for field, value in zip(fused, (1, 9, 0), strict=True):
            field[:6, :6, :6] = value
        fused.distances[1:5, 1:5, 1:5] = -1
        return fused

    monkeypatch.setattr(module, "fuse", with_a_crumb)
    monkeypatch.setattr(module, "LOOSE", 0.2)  # the ball is small
    with pytest.warns(UserWarning, match="1 loose parts are left out"):
        ball = surface(run)
    assert trimesh.Trimesh(ball.vertices, ball.faces).body_count == 1
