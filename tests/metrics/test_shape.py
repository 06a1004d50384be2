import os

import numpy as np
import pytest
import trimesh
from support.refused import refusing

from pp_cl.engine.grid import Grid
from pp_cl.errors import UserError
from pp_cl.metrics.shape import (
    RUN,
    Mesh,
    Surface,
    overlap,
    read_mesh,
    sample_surface,
)

SQUARE = Mesh(
    np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
)


def test_launches_add_up(dev, monkeypatch):
    advances = []
    surface = sample_surface(dev, SQUARE, Grid((0.0, 0, 0), 0.03, (2, 2, 2)), 5000)
    monkeypatch.setattr("pp_cl.metrics.shape.LAUNCH", 3 * RUN)
    many = sample_surface(dev, SQUARE, surface.grid, 5000, advance=advances.append)
    np.testing.assert_array_equal(surface.bits, many.bits)
    assert sum(advances) == 5000 and len(advances) == 7


def test_the_grid_grows_around_the_mesh_in_step(dev):
    grid = Grid((0.3, 0.3, 0.3), 0.25, (2, 2, 2))
    surface = sample_surface(dev, SQUARE, grid, 100)
    np.testing.assert_allclose(surface.grid.origin, (-0.2, -0.2, -0.2), atol=1e-12)
    assert surface.grid.dims == (6, 6, 4) and surface.grid.voxel_size == grid.voxel_size


def test_overlap_by_hand():
    """A 3x2x1 grid has surface vertices (1, 0), (0, 1), (1, 1); two of four points are there."""
    grid = Grid((0.0, 0, 0), 1.0, (3, 2, 1))
    ids = grid.ids(np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (2, 1, 0)]))
    surface = Surface(grid, np.array([[0b010], [0b011]], np.uint32), 3)
    scores = overlap(surface, grid, ids)
    assert scores == {"points": 4, "iou": 2 / 5, "recall": 2 / 3, "precision": 2 / 4}
    larger = Surface(
        Grid((-1.0, -1, 0), 1.0, (4, 3, 1)), np.array([[0], [0b100], [0b110]], np.uint32), 3
    )
    assert overlap(larger, grid, ids)["recall"] == 2 / 3


def test_what_cannot_be_sampled(dev):
    grid = Grid((0.0, 0, 0), 1.0, (2, 2, 2))
    flat = Mesh(SQUARE.vertices, np.array([[0, 1, 1]]))
    with pytest.raises(UserError, match="no triangle with an area"):
        sample_surface(dev, flat, grid, 10)
    with pytest.raises(UserError, match="in the world of the scene"):
        sample_surface(dev, Mesh(SQUARE.vertices * 1e6, SQUARE.faces), grid, 10)


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "off", "glb"])
def test_meshes_are_read(tmp_path, suffix):
    box = trimesh.creation.box((1, 2, 3))
    path = tmp_path / f"box.{suffix}"
    box.export(path)
    mesh = read_mesh(path)
    assert len(mesh.faces) == 12
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (1, 2, 3))


BAD_FILES = {
    "empty": ("mesh.ply", b""),
    "1e9 vertices": (
        "mesh.ply",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n" + bytes(1000),
    ),
    "points only": ("mesh.off", b"OFF\n1 0 0\n0 0 0\n"),
    "NaN": ("mesh.off", b"OFF\n3 1 0\n0 0 nan\n1 0 0\n0 1 0\n3 0 1 2\n"),
    "a face beyond": ("mesh.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"),
    "two coordinates": ("mesh.obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n"),
    "unknown kind": ("mesh.xyz1", b"1 2 3"),
    "missing": ("mesh.stl", None),
}


def test_a_mesh_of_at_most_so_many_bytes(tmp_path):
    (tmp_path / "mesh.obj").touch()
    os.truncate(tmp_path / "mesh.obj", 2**36)
    with refusing(tmp_path / "mesh.obj", "is larger than"):
        read_mesh(tmp_path / "mesh.obj")


@pytest.mark.parametrize("case", BAD_FILES)
def test_a_bad_mesh_is_one_line(tmp_path, case):
    name, content = BAD_FILES[case]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with refusing(tmp_path / name):
        read_mesh(tmp_path / name)
