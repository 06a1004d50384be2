import json

import pytest
from support.refused import failure
from support.runs import arguments
from support.scenes import ball_image, ring_cameras

from pp_cl.cli import main
from pp_cl.config import assign, preset
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.views import View
from pp_cl.files.image import read_rgba
from pp_cl.files.run_folder import RunFolder
from pp_cl.scene.hull import build_grid
from pp_cl.scene.listing import scene_frames
from pp_cl.scene.load import load_scene
from pp_cl.scene.readers.transforms import write_scene
from pp_cl.session.memory import Memory, Place

SIZES = ((48, 48), (37, 29), (24, 40))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Views of three sizes, in some of which the ball is off the middle. A crop of 24 pixels fits
    along all axes but one.
    """
    folder = tmp_path_factory.mktemp("mixed") / "ball"
    splits = {}
    of_test = ring_cameras(37, 48)[5::12][:3]  # none of these is a training camera
    for split, cameras in (("train", ring_cameras(9, 48)), ("test", of_test)):
        views = []
        for i, camera in enumerate(cameras):
            width, height = SIZES[i % 3]
            crop = camera.resized(width, height)
            views.append(View(f"{split}/r_{i}.png", crop, ball_image(crop)))
        splits[split] = views
    write_scene(splits, folder)
    return str(folder)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("mixed") / "run"
    assert main(arguments(scene, out, 1)) == 0
    return out


def test_a_training_learns(trained):
    psnr = [row["psnr"] for row in RunFolder(trained).rows() if "psnr" in row]
    assert psnr[-1] > psnr[0] + 3


def test_each_view_is_measured_at_its_size(scene, trained):
    assert main(["eval", str(trained), "--save-images"]) == 0
    result = json.loads((trained / "eval" / "metrics.json").read_text())
    for i, (row, size) in enumerate(zip(result["per_image"], SIZES, strict=True)):
        saved = read_rgba(trained / "eval" / "images" / f"r_{i}.png")
        assert saved.shape[1::-1] == size and row["psnr"] > 10


def test_it_is_rendered_shown_and_exported(trained, tmp_path):
    out = tmp_path / "frames"
    assert (
        main(["render", str(trained), "--path", "test", "--format", "png", "--out", str(out)]) == 0
    )
    assert [read_rgba(f).shape[1::-1] for f in sorted(out.glob("0*.png"))] == list(SIZES)
    error = failure("render", trained, "--path", "test", "--format", "mp4")
    assert "--path test: its images differ in size" in error
    for words in (
        ["info", str(trained), "--picture", str(tmp_path / "a.png")],
        ["export", str(trained), "--format", "scene", "--out", str(tmp_path / "s")],
        ["export", str(trained), "--format", "ply", "--out", str(tmp_path / "s.ply")],
    ):
        assert main(words) == 0


def test_memory_is_planned_for_the_largest(dev, scene):
    config = preset("tiny")
    settings = {"points.count": "400", "network.widths": "16,16,16", "train.crop": "0"}
    for key, value in settings.items():
        assign(config, key, value, "test")
    views = load_scene(scene).splits["train"]
    hull = build_grid(dev, views, 400)
    net = UNet(dev, config.network.widths)
    frames = scene_frames(scene)
    orders = frames, frames[::-1], [max(frames, key=lambda view: view.camera.width)] * len(frames)
    mixed, turned, largest = (
        Memory(config, net, order).need(config, Place(hull.grid, len(hull.ids), (2, 6)))
        for order in orders
    )
    assert mixed == turned and 0.9 * largest.device < mixed.device <= largest.device
