"""Pixels marked as showing a hand or the like, not the object, change nothing."""

import json

import numpy as np
import pytest
from PIL import Image
from support.checkpoints import load_checkpoint
from support.runs import SETTINGS, set_words, spoken
from support.scenes import ball_image, ring_cameras, write_ball_scene

from pp_cl.config import preset
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import PointCloud
from pp_cl.engine.step import Trainer
from pp_cl.engine.views import View
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.load import load_scene

HAND = np.s_[14:31, 20:29]  # rows, columns of the hand, which cuts the ball's outline
SPLITS = ("train", "test")


def with_hand(folder, colour):
    write_ball_scene(folder)
    for split in SPLITS:
        for file in sorted((folder / split).iterdir())[::2]:
            image = np.array(Image.open(file))
            image[HAND] = colour
            Image.fromarray(image).save(file)
    return folder


def hand_masks(folder, rest=0, hand=255):
    for split in SPLITS:
        (folder / split).mkdir(parents=True)
        for i in range(0, 8 if split == "train" else 2, 2):
            mask = np.full((48, 48), rest, np.uint8)
            mask[HAND] = hand
            Image.fromarray(mask).save(folder / split / f"r_{i}.png")


def in_the_scene(scene):
    hand_masks(scene / "ignore")
    return []


def elsewhere(scene):
    hand_masks(scene.parent / "hands")
    return ["--ignore", scene.parent / "hands"]


def as_nerfstudio_names_them(scene):
    """Write masks that are white in usable pixels, besides the object's alpha."""
    hand_masks(scene / "of_use", 255, 0)
    for split in SPLITS:
        file = scene / f"transforms_{split}.json"
        data = json.loads(file.read_text())
        for frame in data["frames"][::2]:
            frame["mask_path"] = f"of_use/{split}/{frame['file_path'].rpartition('/')[2]}.png"
        file.write_text(json.dumps(data))
    return []


WAYS = (in_the_scene, elsewhere, as_nerfstudio_names_them)


def trained(scene, out, words):
    """(arrays, mean metrics) of a training with exposure corrections and SSIM."""
    sets = set_words(SETTINGS, train__iterations=20, train__exposure="on", train__ssim_weight=0.2)
    status, lines = spoken(["train", scene, "--out", out, *words, "--downscale", "2", *sets])
    assert status == 0, lines
    assert spoken(["eval", out])[0] == 0
    arrays = load_checkpoint(out / "checkpoint.npz")[1]
    return arrays, json.loads((out / "eval/metrics.json").read_text())["mean"]


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The results with a hand that hides what is behind it."""
    folder = tmp_path_factory.mktemp("hand")
    scene = with_hand(folder / "scene", (255, 0, 90, 255))
    return trained(scene, folder / "run", in_the_scene(scene))


def same(one, other):
    (arrays, means), (others, other_means) = one, other
    return means == other_means and all(
        np.array_equal(arrays[name], others[name]) for name in arrays
    )


@pytest.mark.parametrize("way", WAYS)
def test_ignored_pixels_have_no_effect_on_a_bit(tmp_path, expected, way):
    """It does not matter whether these are opaque, which adds to the hull, or transparent, which
    takes from it.
    """
    scene = with_hand(tmp_path / "scene", (0, 200, 0, 0))
    assert same(trained(scene, tmp_path / "run", way(scene)), expected)


@pytest.mark.parametrize("ignores", [False, True])
def test_the_network_learns_the_same_where_tiles_are_left_out(dev, monkeypatch, ignores):
    """Ignored pixels are as white as those around them, but have another gradient."""
    ignored = np.zeros((128, 128), bool)
    ignored[:40, :36] = ignores
    views = []
    for camera in ring_cameras(4, 128, field_of_view=1.2):
        image = ball_image(camera) * np.where(ignored, 0, 1).astype(np.uint8)[..., None]
        views.append(View("a", camera, image, ignored=ignored if ignores else None))
    hull, config = build_grid(dev, views, 2000), preset("full")
    config.train.crop, config.train.refine_at, config.train.pixel_jitter = 0, (1.0, 1.0), False

    def gradient(least):
        monkeypatch.setattr("pp_cl.engine.network.unet.LEAST_PIXELS", least)
        net = UNet.of_settings(dev, config.network, seed=0)
        cloud = PointCloud.create(dev, hull.ids)
        model = Model(dev, hull.grid, depth_range(views, hull), cloud, net=net)
        trainer = Trainer(dev, config, model, views)
        trainer.train_step()
        return trainer.optimiser.moments["m"].get()  # 0.1 times the gradients

    whole, planned = gradient(2**30), gradient(1)
    assert np.linalg.norm(whole - planned) < 1e-5 * np.linalg.norm(whole)


def test_the_lens_moves_them_as_it_moves_the_image(tmp_path, dev):
    """Other pixels are as without the hand, except for the ringing of the spline."""
    scene = with_hand(tmp_path / "scene", (255, 0, 90, 255))
    hand_masks(scene / "ignore")
    write_ball_scene(tmp_path / "ball")
    for folder in (scene, tmp_path / "ball"):
        file = folder / "transforms_train.json"
        data = json.loads(file.read_text()) | {"k1": 0.15, "p1": 0.02}
        file.write_text(json.dumps(data))
    views, right = (
        load_scene(folder, downscale=2, dev=dev).splits["train"]
        for folder in (scene, tmp_path / "ball")
    )
    assert [view.ignored is not None for view in views] == [True, False] * 4
    for view, other in zip(views, right, strict=True):
        ignored = np.zeros((48, 48), bool) if view.ignored is None else view.ignored
        assert (ignored.mean() > 0.066) == (view.ignored is not None)
        assert ignored.mean() < 0.12
        off = view.image.astype(int) - other.image
        assert np.abs(off[~ignored & (other.image[..., 3] > 128)]).max() < 40
