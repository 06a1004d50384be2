import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.checkpoints import load_checkpoint
from support.runs import arguments, train_and_interrupt

from pp_cl.cli import main
from pp_cl.drivers import open_device
from pp_cl.engine.training.exposure import Exposure, decided_at
from pp_cl.metrics.psnr_ssim import exposed_alike
from pp_cl.scene.demo import demo_views
from pp_cl.scene.readers.transforms import write_scene

VIEWS, STEPS = 64, 500
DECIDED = decided_at(0, VIEWS)
GAINS = np.exp(np.random.default_rng(4).uniform(np.log(0.25), 0, (VIEWS, 3)))
EVERY = DECIDED // 2  # steps of a checkpoint
SETTINGS = {"downscale": 1, "train__iterations": STEPS, "train__checkpoint_every": EVERY}


def write_demo(dev, folder, gains):
    """The demo's folder, small, with few images, multiplied by gains (VIEWS, 3)."""
    views = demo_views(dev, "train", VIEWS, size=48)
    images = [view.image.copy() for view in views]
    for image, gain in zip(images, gains, strict=True):
        image[..., :3] = np.rint(gain * image[..., :3])
    exposed = [replace(view, image=image) for view, image in zip(views, images, strict=True)]
    write_scene({"train": exposed, "test": exposed[:2]}, folder)
    return str(folder)


@pytest.fixture(scope="module")
def exposed(runs, tmp_path_factory):
    def make(folder):
        scene = write_demo(open_device(), folder / "scene", GAINS)
        assert main(arguments(scene, folder / "run", **SETTINGS)) == 0

    folder = runs.made("exposed", make)
    run = shutil.copytree(folder / "run", tmp_path_factory.mktemp("exposed") / "run")
    assert load_checkpoint(run / "checkpoint.npz")[0]["exposed"]
    return str(folder / "scene"), run


def test_gains_are_found_and_a_training_goes_on_with_them(exposed, tmp_path, monkeypatch):
    (scene, finished), run, saved = exposed, tmp_path / "run", 0
    for stop in (DECIDED - 1, DECIDED, STEPS - 1):
        train_and_interrupt(scene, run, stop - saved, monkeypatch, **SETTINGS)
        header, arrays = load_checkpoint(run / "checkpoint.npz")
        saved = header["step"]
        assert saved == stop // EVERY * EVERY
    error = np.log(arrays["exposure"][..., 3] / GAINS)
    error -= error.mean(axis=0)
    assert error.std() < 0.4 * np.log(GAINS).std()
    assert main(["train", scene, "--out", str(run)]) == 0
    checkpoints = [folder / "checkpoint.npz" for folder in (finished, run)]
    assert checkpoints[0].read_bytes() == checkpoints[1].read_bytes()


def test_views_are_compared_without_and_with_their_best_gains(exposed, capsys):
    _, run = exposed
    assert main(["eval", str(run)]) == 0
    result = json.loads((run / "eval" / "metrics.json").read_text())
    mean, after = result["mean"], result["mean_after_gains"]
    assert after["psnr"] > mean["psnr"] + 1 and after["ssim"] > mean["ssim"]
    assert f"{after['psnr']:.4f}" in capsys.readouterr().out
    assert after["psnr"] == pytest.approx(
        np.mean([row["after_gains"]["psnr"] for row in result["per_image"]])
    )


def test_gains_explain_nothing_where_there_is_no_error(dev):
    exposure, alpha = Exposure(dev, 2, is_applied=False), dev.upload(np.ones((5, 7)), np.float32)
    for view in range(2):
        exposure.fit(view, dev.zeros((5, 7, 3)), dev.zeros((5, 7, 3)), alpha, (0, 0))
    assert exposure.explained() == 0


def test_the_best_gains_are_those_of_the_object(rng):
    alpha = rng.random((9, 7))
    colour, white = rng.random((9, 7, 3)) * alpha[..., None], 1 - alpha[..., None]
    truth = white + colour * [0.5, 0.9, 0.2]
    found = exposed_alike(truth, white + colour, alpha)
    np.testing.assert_allclose(found, white + colour, atol=1e-12)


def test_equal_exposures_change_no_bit(dev, tmp_path):
    scene = write_demo(dev, tmp_path / "scene", np.ones((VIEWS, 3)))
    settings = SETTINGS | {"train__iterations": DECIDED + 22}
    assert main(arguments(scene, tmp_path / "auto", **settings)) == 0
    assert main(arguments(scene, tmp_path / "off", train__exposure="off", **settings)) == 0
    auto, off = (load_checkpoint(tmp_path / run / "checkpoint.npz") for run in ("auto", "off"))
    assert auto[0] == off[0] and auto[1].keys() == off[1].keys()
    for name, array in off[1].items():
        np.testing.assert_array_equal(auto[1][name], array)
