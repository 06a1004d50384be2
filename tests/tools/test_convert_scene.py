import numpy as np
import pytest
from support.same_scene import held_out, same, views
from support.scenes import write_ball_scene

from pp_cl.scene.listing import scene_format
from pp_cl.scene.load import load_scene
from tools.convert_scene import FORMATS, convert, main

READER = {"nerf_synthetic": "transforms", "nerfstudio": "transforms"}
PLACE = {"co3d": "object/sequence"}  # where the scene lies in the written folder


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_written_comes_back(tmp_path, name):
    many = views(centred=name == "llff", alike=name in ("llff", "nsvf"))
    splits = {"test": many[:4], "train": many[4:9], "val": many[9:]}
    if name in ("colmap", "llff", "neus"):
        splits = held_out(many)
    convert(splits, tmp_path / "scene", name)
    folder = tmp_path / "scene" / PLACE.get(name, ".")
    assert scene_format(str(folder)) == READER.get(name, name)
    same(folder, splits)


def test_the_command(tmp_path, capsys):
    scene = write_ball_scene(tmp_path / "ball", views=6, size=24)
    words = [scene, str(tmp_path / "c"), "--format", "colmap"]
    assert main(words) == 2 and "--hold-out" in capsys.readouterr().err
    assert main([*words, "--hold-out"]) == 0
    read = load_scene(tmp_path / "c", ("train", "test")).splits
    stored = load_scene(scene, ("train", "test")).splits
    count = sum(map(len, stored.values()))
    assert len(read["test"]) == -(-count // 8) and len(read["train"]) == count - len(read["test"])
    np.testing.assert_array_equal(read["test"][0].image, stored["test"][0].image)
    assert main(words) == 2 and "exists already" in capsys.readouterr().err
