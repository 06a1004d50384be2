import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.checkpoints import load_checkpoint
from support.runs import arguments, rows, train_and_interrupt

from pp_cl.cli import main
from pp_cl.drivers import open_device
from pp_cl.engine.training.exposure import Exposure, decided_at
from pp_cl.metrics.psnr_ssim import coloured_alike
from pp_cl.scene.demo import demo_views
from pp_cl.scene.readers.transforms import write_scene

VIEWS, STEPS = 48, 500
DECIDED, LAST = (decided_at(0, VIEWS, is_last=is_last) for is_last in (False, True))
GAINS = np.exp(np.random.default_rng(4).uniform(np.log(0.25), 0, (VIEWS, 3)))
MATRICES = 0.8 * np.eye(3) + np.random.default_rng(5).uniform(-0.25, 0.25, (VIEWS, 3, 3))
# a model this small has errors that gains do not explain
NO_MATRICES = "pp_cl.engine.training.exposure.LEAST_BEYOND", 1.0
EVERY = DECIDED // 2  # steps between checkpoints
SETTINGS = {"downscale": 1, "train__iterations": STEPS, "train__checkpoint_every": EVERY}


def write_demo(dev, folder, matrices):
    """Write a small demo scene, its colours multiplied by matrices (VIEWS, 3, 3)."""
    views = demo_views(dev, "train", VIEWS, size=48)
    images = [view.image.copy() for view in views]
    for image, matrix in zip(images, matrices, strict=True):
        image[..., :3] = np.rint(np.clip(image[..., :3] @ matrix.T, 0, 255))
    exposed = [replace(view, image=image) for view, image in zip(views, images, strict=True)]
    write_scene({"train": exposed, "test": exposed[:2]}, folder)
    return str(folder)


@pytest.fixture(scope="module")
def exposed(runs, tmp_path_factory):
    def make(folder):
        scene = write_demo(open_device(), folder / "scene", GAINS[:, None] * np.eye(3))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(*NO_MATRICES)
            assert main(arguments(scene, folder / "run", **SETTINGS)) == 0

    folder = runs.made("exposed", make)
    run = shutil.copytree(folder / "run", tmp_path_factory.mktemp("exposed") / "run")
    assert load_checkpoint(run / "checkpoint.npz")[0]["exposed"]
    return str(folder / "scene"), run


def test_gains_are_found_and_a_training_goes_on_with_them(exposed, tmp_path, monkeypatch):
    monkeypatch.setattr(*NO_MATRICES)
    (scene, finished), run, saved = exposed, tmp_path / "run", 0
    for stop in (DECIDED - 1, DECIDED, LAST, STEPS - 1):
        train_and_interrupt(scene, run, stop - saved, monkeypatch, **SETTINGS)
        header, arrays = load_checkpoint(run / "checkpoint.npz")
        saved = header["step"]
        assert saved == stop // EVERY * EVERY
    gains = arrays["exposure"][:, 16:, :3].diagonal(axis1=1, axis2=2)
    error = np.log(gains / GAINS)
    error -= error.mean(axis=0)
    assert error.std() < 0.4 * np.log(GAINS).std()
    assert main(["train", scene, "--out", str(run)]) == 0
    checkpoints = [folder / "checkpoint.npz" for folder in (finished, run)]
    assert checkpoints[0].read_bytes() == checkpoints[1].read_bytes()


def test_matrices_are_found_and_a_training_goes_on_with_them(dev, tmp_path, monkeypatch, capsys):
    scene, whole, run = (
        write_demo(dev, tmp_path / "scene", MATRICES),
        tmp_path / "a",
        tmp_path / "b",
    )
    assert main(arguments(scene, whole, **SETTINGS)) == 0
    assert "a matrix for each view is learned with the model" in capsys.readouterr().err
    assert main(["eval", str(whole)]) == 0
    result = json.loads((whole / "eval" / "metrics.json").read_text())
    assert result["mean_after_colour"]["psnr"] > result["mean"]["psnr"] + 1
    train_and_interrupt(scene, run, STEPS - 1, monkeypatch, **SETTINGS)
    matrices = load_checkpoint(run / "checkpoint.npz")[1]["exposure"][:, 16:, :3]
    assert matrices.mean(axis=0) == pytest.approx(np.eye(3), abs=1e-5)
    off = tmp_path / "off"
    assert main(arguments(scene, off, train__exposure="off", **SETTINGS)) == 0
    learned, without = (np.mean([row["psnr"] for row in rows(out)[-6:-1]]) for out in (whole, off))
    assert learned > without + 1
    assert main(["train", scene, "--out", str(run)]) == 0
    checkpoints = [folder / "checkpoint.npz" for folder in (whole, run)]
    assert checkpoints[0].read_bytes() == checkpoints[1].read_bytes()
    assert main(["train", scene, "--out", str(run), "--iterations", str(STEPS + 5)]) == 0
    assert load_checkpoint(checkpoints[1])[0]["exposed"] == "matrices"  # as the model learned


def test_views_are_compared_without_and_with_their_colour(exposed, capsys):
    _, run = exposed
    assert main(["eval", str(run)]) == 0
    result = json.loads((run / "eval" / "metrics.json").read_text())
    mean, after = result["mean"], result["mean_after_colour"]
    assert after["psnr"] > mean["psnr"] + 1 and after["ssim"] > mean["ssim"]
    assert f"{after['psnr']:.4f}" in capsys.readouterr().out
    assert after["psnr"] == pytest.approx(
        np.mean([row["after_colour"]["psnr"] for row in result["per_image"]])
    )


def test_gains_explain_nothing_where_there_is_no_error(dev):
    exposure, alpha = Exposure(dev, 2, is_applied=False), dev.upload(np.ones((5, 7)), np.float32)
    for view in range(2):
        exposure.fit(view, dev.zeros((5, 7, 3)), dev.zeros((5, 7, 3)), alpha, (0, 0))
    assert exposure.explained() == (0, 0, 0)


def test_a_view_gets_the_colour_of_its_other_half(rng):
    alpha = rng.random((49, 37))
    colour, white = rng.random((49, 37, 3)) * alpha[..., None], 1 - alpha[..., None]
    turned = colour @ (np.eye(3) + 0.1 * rng.normal(size=(3, 3))) + 0.05 * alpha[..., None]
    recoloured = coloured_alike(white + colour, white + turned, alpha)
    np.testing.assert_allclose(recoloured, np.clip(white + turned, 0, 1), atol=0.01)


def test_equal_exposures_change_no_bit(dev, tmp_path):
    scene = write_demo(dev, tmp_path / "scene", np.tile(np.eye(3), (VIEWS, 1, 1)))
    settings = SETTINGS | {"train__iterations": LAST + 22}
    assert main(arguments(scene, tmp_path / "auto", **settings)) == 0
    assert main(arguments(scene, tmp_path / "off", train__exposure="off", **settings)) == 0
    auto, off = (load_checkpoint(tmp_path / run / "checkpoint.npz") for run in ("auto", "off"))
    assert auto[0] == off[0] and auto[1].keys() == off[1].keys()
    for name, array in off[1].items():
        np.testing.assert_array_equal(auto[1][name], array)
