import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.scenes import move_scene, write_ball_scene

from pp_cl.scene.identity import difference, identity, unpacked_views
from pp_cl.scene.image_file import pixel_digest
from pp_cl.scene.listing import scene_frames
from pp_cl.scene.load import load_scene


@pytest.fixture
def folder(tmp_path):
    write_ball_scene(tmp_path / "ball")
    return tmp_path / "ball"


def views_of(folder, **options):
    return load_scene(folder, **options).splits["train"]


def repaint(file, channel):
    pixels = np.array(Image.open(file))
    pixels[20, 20, channel] ^= 1
    Image.fromarray(pixels).save(file)


def test_a_digest_is_that_of_the_pixels(folder):
    view = views_of(folder)[3]
    pixels = np.array(Image.open(folder / view.name).convert("RGBA"))
    assert view.digest == hashlib.sha256(pixels.tobytes()).hexdigest()[:16]
    assert pixel_digest(pixels[:, ::2]) == pixel_digest(pixels[:, ::2].copy())
    assert view.reduced(2).digest == view.moved((1, 2, 3)).digest == view.digest


def test_the_same_scene_elsewhere_and_in_other_files(folder):
    views, header = views_of(folder), identity(views_of(folder))
    assert header["pixels"] == {view.name: view.digest for view in views}
    Image.open(folder / "train/r_1.png").save(folder / "train/r_1.png", compress_level=0)
    moved = folder.rename(folder.parent / "moved")
    assert difference(header, scene_frames(str(moved)), views_of(moved)) == ""


@pytest.mark.parametrize("far, said", [(1e-9, False), (1e-4, True)])
def test_cameras_that_another_processor_rounds_otherwise_are_the_same(folder, far, said):
    views, listed = views_of(folder), scene_frames(str(folder))
    header = identity(views)
    listed = [replace(o, camera=replace(o.camera, pose=o.camera.pose - far)) for o in listed]
    assert bool(difference(header, listed, views)) == said


def test_names_cameras_and_depth_ranges_come_back_to_the_bit(folder):
    listed = [replace(image_file, depth_range=None) for image_file in scene_frames(str(folder))]
    views = [replace(view, depth_range=None) for view in views_of(folder)]
    views[1] = replace(views[1], depth_range=(0.1, 7.3))
    listed[1] = replace(listed[1], depth_range=(0.1, 7.3))
    packed = unpacked_views(json.loads(json.dumps(identity(views)["views"])))
    for view, image_file in zip(packed, listed, strict=True):
        assert np.array_equal(view.camera.pose, image_file.camera.pose)
        lens = [replace(p, camera=replace(p.camera, pose=None)) for p in (view, image_file)]
        assert lens[0] == lens[1]


@pytest.mark.parametrize("channel", [0, 3], ids=["colour", "mask"])
def test_other_pixels_are_named(folder, channel):
    header = identity(views_of(folder))
    repaint(folder / "train/r_1.png", channel)
    views = views_of(folder)
    assert difference(header, scene_frames(folder), views).startswith("train/r_1.png: other pixels")
    assert difference(header, scene_frames(folder), views[:1]) == ""
    repaint(folder / "train/r_5.png", channel)
    views = views_of(folder)
    assert difference(header, scene_frames(folder), views).startswith(
        "train/r_1.png, train/r_5.png: other pixels"
    )


def test_other_cameras_and_names_are_told_and_more_views_are_none(folder):
    listed, reason = scene_frames(folder), "its training views have other names or cameras"
    header = identity(views_of(folder))
    assert difference(header, listed[1:]) == reason
    assert difference(header, [replace(listed[0], name="train/x.png"), *listed[1:]]) == reason
    assert difference(header, [replace(listed[0], name="train/x.png"), *listed]) == ""
    move_scene(folder, (0, 0, 1e-3))
    assert difference(header, scene_frames(folder)) == reason
