import shutil

import numpy as np
import pytest
import trimesh

from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.run import load
from pp_cl.scene.load import load_scene
from pp_cl.scene.readers.transforms import write_scene
from pp_studio.export import AXES, FORMATS
from pp_studio.export.formats import check_target, export_run, renderings
from pp_studio.export.splat import Y_DOWN, Y_UP, upright


@pytest.mark.parametrize("name", FORMATS)
def test_it_is_written_where_it_belongs_and_twice_alike(name, run, tmp_path):
    lines, contents = [], []
    for _ in range(2):
        path = check_target(name, tmp_path, None)
        assert path.parent == tmp_path / "export"
        lines.append(export_run(run, name, path))
        files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        contents.append([file.read_bytes() for file in files])
        shutil.rmtree(tmp_path / "export")
    assert lines[0] == lines[1] and contents[0] == contents[1] and contents[0]
    assert any(character.isdigit() for character in lines[0])


def test_a_path_may_be_a_text_and_a_format_that_there_is_not_is_one_line(run, tmp_path):
    export_run(run, "glb", str(tmp_path / "a.glb"))
    assert (tmp_path / "a.glb").stat().st_size
    with pytest.raises(UserError, match="no format obj; choose from splat, "):
        export_run(run, "obj", tmp_path / "a.obj")


@pytest.mark.parametrize("name", ["ply", "mesh", "textured", "splat"])
def test_a_box_holds_a_part_and_axes_turn_it(name, run, tmp_path):
    box, places = (-1, -1, -1, 1, 1, 0.25), {}
    suffix = FORMATS[name][1][0]
    for axes in AXES:
        path = tmp_path / f"{axes}{suffix}"
        export_run(run, name, path, box=box, axes=axes)
        read = trimesh.load(path, process=False)
        [geometry] = read.geometry.values() if suffix == ".glb" else [read]
        places[axes] = geometry.vertices
    voxel_size = run.model.grid.voxel_size
    assert places["scene"][:, 2].max() == pytest.approx(0.25, abs=2 * voxel_size)
    assert places["scene"][:, 2].min() < -0.5, "there is more of the ball below"
    turn = upright(run, Y_DOWN if name == "splat" else Y_UP)
    np.testing.assert_allclose(places["scene"] @ turn.T, places["viewer"], atol=1e-5)


def test_they_read_back_as_a_scene(run, tmp_path):
    write_scene(renderings(run), tmp_path / "scene")
    scene = load_scene(tmp_path / "scene", ("train", "test"))
    for split in ("train", "test"):
        views = scene.splits[split]
        for view, camera in zip(views, run.cameras(split), strict=True):
            assert view.camera.pose == pytest.approx(camera.pose)
            for name in ("fx", "fy", "cx", "cy", "width", "height"):
                assert getattr(view.camera, name) == pytest.approx(getattr(camera, name))
            rendered = run.render(camera)
            assert np.array_equal(view.image, to_8bit(rendered.rgba()))
            rgba = view.image / 255
            over_white = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
            covered = rendered.alpha > 0.2  # with less alpha, colours are clipped
            assert np.abs(over_white - rendered.colour)[covered].mean() < 0.01


def test_a_scene_without_test_views_gives_training_views(run, run_folder, tmp_path):
    shutil.copytree(run.config.scene.path, tmp_path / "ball")
    (tmp_path / "ball" / "transforms_test.json").unlink()
    moved = load(run_folder, run.dev, scene=str(tmp_path / "ball"))
    with pytest.warns(UserWarning, match="no test views are exported: .*test"):
        splits = renderings(moved)
    assert {split: len(views) for split, views in splits.items()} == {"train": 12}
