import json
import shutil

import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.files.image import read_rgba
from pp_cl.scene.outline import OUTLINE


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    scene = write_ball_scene(folder / "here" / "ball")
    assert main(arguments(scene, folder / "here" / "run", train__iterations=80)) == 0
    shutil.move(folder / "here" / "run", folder / "run")
    shutil.rmtree(folder / "here")
    return folder / "run"


def test_a_run_alone_is_exported(alone, tmp_path):
    mesh, scene = tmp_path / "mesh.ply", tmp_path / "scene"
    for kind, out in {"mesh": mesh, "scene": scene}.items():
        assert main(["export", str(alone), "--format", kind, "--out", str(out)]) == 0
    frames = json.loads((scene / "transforms_train.json").read_text())["frames"]
    assert mesh.is_file() and len(frames) == len(list((scene / "train").iterdir())) == 8


def test_a_run_alone_says_what_is_in_it(alone, tmp_path, capsys):
    sheet = tmp_path / "points.png"
    assert main(["info", str(alone), "--picture", str(sheet), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["grid"]["voxel_size_pixels"] > 0 and not found["scene_is_there"]
    assert found["views"] == {"count": 8, "images": {"48x48": 8}}
    assert found["files"]["checkpoint.npz"] == (alone / "checkpoint.npz").stat().st_size
    assert sum(found["files"].values()) == sum(
        file.stat().st_size for file in alone.rglob("*") if file.is_file() and file.name[0] != "."
    )
    image = read_rgba(sheet)[..., :3]
    drawn = (image == OUTLINE).all(-1)
    assert drawn.any() and image[~drawn].std() > 20, "the outline lies over renderings"
    assert main(["info", str(alone)]) == 0
    text = capsys.readouterr().out
    assert "8 of 48x48" in text and "not there" in text
