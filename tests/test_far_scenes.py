import json
import re

import numpy as np
import plyfile
import pytest
import trimesh
from scipy.spatial import cKDTree
from support.checkpoints import load_checkpoint
from support.runs import arguments
from support.scenes import move_scene, write_ball_scene

from pp_cl.cli import main
from pp_cl.engine.raster.footprint import MOST_OF_GAUSSIANS
from pp_cl.metrics.shape import read_mesh
from pp_cl.run import load
from pp_studio.export.formats import export_run
from pp_studio.export.gltf import write_glb
from pp_studio.export.mesh import Mesh, write_mesh
from pp_studio.export.points import coloured_points, in_world, write_ply
from pp_studio.export.splat import splats, write_splat_glb

FAR = np.array([1e6, -1e6, 1e6])
UNIT = 2.0**-24  # eyes are multiples: float64 holds them exactly 1e6 away, and the grid, too
CHANGES = {"train__iterations": 24, "train__prune_every": 8, "train__prune_weight": 0.05}
CHANGES |= {"train__refine_at": "0.5,1.0", "points__count": 400}


def trained(folder, by):
    """(header, arrays, mean PSNR of the test views, folder) of a small training on the ball, moved
    by `by`.
    """
    scene = write_ball_scene(folder / "ball")
    move_scene(folder / "ball", by, UNIT)
    assert main(arguments(scene, folder / "run", 1, **CHANGES)) == 0
    assert main(["eval", str(folder / "run")]) == 0
    metrics = json.loads((folder / "run" / "eval" / "metrics.json").read_text())
    return (
        *load_checkpoint(folder / "run" / "checkpoint.npz"),
        metrics["mean"]["psnr"],
        folder / "run",
    )


@pytest.fixture(scope="module")
def at_origin(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("origin"), 0)


@pytest.fixture(scope="module")
def far(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("far"), FAR)


def test_exact_moves_give_the_same_bits(at_origin, far):
    header, arrays, psnr, _ = far
    expected, expected_arrays, expected_psnr, _ = at_origin
    assert psnr == expected_psnr
    assert arrays.keys() == expected_arrays.keys()
    for name, array in arrays.items():
        assert np.array_equal(array, expected_arrays[name]), name
    grid, other = header["grid"], expected["grid"]
    assert (grid["voxel_size"], grid["dims"]) == (other["voxel_size"], other["dims"])
    assert (np.subtract(grid["origin"], other["origin"]) == FAR).all()  # exact: origins are float64
    assert header["depth_range"] == expected["depth_range"]


@pytest.fixture(scope="module")
def far_run(far, session_device):
    return load(far[-1], session_device)


def glb_points(path):
    """(N, 3) world positions of the points in a GLB file."""
    cloud = trimesh.load(path)
    [name] = cloud.graph.nodes_geometry
    place, _ = cloud.graph[name]
    [read] = cloud.geometry.values()
    return read.vertices + place[:3, 3]


def test_exported_points_keep_their_places_in_the_world(far_run, tmp_path):
    points = coloured_points(far_run)
    positions = far_run.model.positions()[points.rows]
    write_ply(tmp_path / "a.ply", points, far_run.model.cloud)
    vertex = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert np.array_equal(np.stack([vertex[name] for name in "xyz"], 1), positions)
    write_glb(tmp_path / "a.glb", {"POSITION": points.positions})
    np.testing.assert_allclose(glb_points(tmp_path / "a.glb"), positions, rtol=0, atol=1e-6)


def test_exported_splats_keep_their_places_in_the_world(far_run, tmp_path):
    table, origin = splats(far_run, np.eye(3))
    write_splat_glb(tmp_path / "a.glb", table, origin)
    voxel_size = far_run.model.grid.voxel_size
    vertices = far_run.model.grid.positions(far_run.model.cloud.ids.get())
    away, _ = cKDTree(vertices).query(glb_points(tmp_path / "a.glb"), p=np.inf)
    assert away.max() < (MOST_OF_GAUSSIANS + 1e-3) * voxel_size < 1e-6 * np.abs(origin).max()
    assert np.median(away) < voxel_size / 2


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_exported_meshes_keep_their_places_in_the_world(suffix, tmp_path):
    corners = np.array([[0, 0, 0], [0.001, 0, 0], [0, 0.001, 0], [0, 0, 0.001]]) + FAR
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    colours = np.arange(12, dtype=np.uint8).reshape(4, 3) * 20
    path = tmp_path / f"a.{suffix}"
    write_mesh(path, Mesh(in_world(corners, 0.001), faces, colours, len(faces)))
    read = read_mesh(path)
    np.testing.assert_allclose(read.vertices, corners, rtol=0, atol=1e-9)
    assert np.array_equal(read.faces, faces)
    if suffix == "ply":
        vertex = plyfile.PlyData.read(str(path))["vertex"]
        assert np.array_equal(np.stack([vertex[c] for c in ("red", "green", "blue")], 1), colours)


def test_a_mesh_for_printers_is_moved_to_the_origin(far_run, tmp_path):
    """STL holds float32."""
    words = export_run(far_run, "mesh", tmp_path / "a.stl")
    assert re.search("less (999999|1e06|100000[01]), -", words), words
    vertices = trimesh.load(tmp_path / "a.stl").vertices
    assert np.abs(vertices).max() < 5 and len(np.unique(vertices[:, 0])) > 20


def test_files_keep_float32_where_it_holds_the_places():
    assert in_world(np.full((2, 3), 10.0), 0.01).dtype == np.float32
    assert in_world(np.full((2, 3), 200.0), 0.01).dtype == np.float64
