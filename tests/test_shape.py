import json

import numpy as np
import pytest
import trimesh
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.commands.compare_mesh import run_shape
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.metrics.shape import Mesh, overlap, sample_surface
from pp_cl.scene.hull import build_grid
from pp_cl.scene.load import load_scene


@pytest.fixture(scope="module")
def scene(runs):
    return runs.ball(views=6, size=40)


@pytest.fixture(scope="module")
def mesh():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.8)
    return Mesh(ball.vertices, ball.faces)


@pytest.fixture(scope="module")
def trained(runs, scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("shape") / "run"
    return runs.trained(out, scene, 1, train__iterations=20, points__count=1000)


def train(scene, out, **changes):
    assert main(arguments(scene, out, 1, train__iterations=20, **changes)) == 0
    return out


def test_a_run_before_and_after(dev, scene, mesh, trained):
    facts = run_shape(dev, RunFolder(trained), mesh, 40_000)
    hull = build_grid(dev, load_scene(scene).splits["train"], 1000)
    surface = sample_surface(dev, mesh, hull.grid, 40_000)
    before, after = facts["before"], facts["after"]
    assert facts["surface"] == surface.count
    assert before == overlap(surface, hull.grid, hull.ids)
    assert before["recall"] > 0.8  # the hull lacks vertices just outside of the ball
    assert 0 < after["points"] < before["points"]
    with np.load(trained / "checkpoint.npz") as stored:
        assert after == overlap(surface, hull.grid, stored["points.ids"])


def test_a_refined_run_is_compared_on_its_last_grid(dev, scene, mesh, tmp_path):
    changes = {"train__refine_at": "0.3,1", "points__count": 300}
    facts = run_shape(dev, RunFolder(train(scene, tmp_path / "run", **changes)), mesh, 40_000)
    hull = build_grid(dev, load_scene(scene).splits["train"], 300)
    assert facts["grid"] == {
        "dims": [2 * n for n in hull.grid.dims],
        "voxel_size": hull.grid.voxel_size / 2,
    }
    assert facts["before"]["points"] == 8 * len(hull.ids) > facts["after"]["points"]
    assert facts["before"]["recall"] > 0.8


def test_another_scene_is_noticed(dev, mesh, trained, tmp_path):
    other = write_ball_scene(tmp_path / "other", views=5, size=40)
    with pytest.raises(UserError, match="not the one that the run began with"):
        run_shape(dev, RunFolder(trained), mesh, 100, scene=str(other))


def test_the_command_prints_and_writes_the_row(mesh, trained, tmp_path, capsys):
    file = tmp_path / "ball.ply"
    trimesh.Trimesh(mesh.vertices, mesh.faces).export(file)
    words = ["compare", str(trained), "--mesh", str(file), "--samples", "20000"]
    assert main([*words, "--json", str(tmp_path / "row.json")]) == 0
    facts = json.loads((tmp_path / "row.json").read_text())
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[-3:]] == ["training", "before", "after"]
    assert lines[-1].split()[1:3] == [str(facts["after"]["points"]), f"{facts['after']['iou']:.4f}"]
    assert main(["compare", str(file), "--edge", "0.2", "--samples", "1000"]) == 0
    assert "voxel size 0.2" in capsys.readouterr().out
