import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.refused import failure
from support.runs import SETTINGS, arguments

import pp_cl
from pp_cl.cli import main
from pp_cl.config import assign, run_config
from pp_cl.drivers import open_device
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba, to_8bit
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.training import open_training


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """(Run, folder), trained from Python with the settings of support.runs."""
    out = tmp_path_factory.mktemp("runs") / "python"
    return pp_cl.train_scene(scene, out, downscale=2, settings=SETTINGS), out


def test_python_and_the_command_line_train_the_same_bytes(finished, trained):
    for name in ("checkpoint.npz", "config.json"):
        assert (trained[1] / name).read_bytes() == (finished / name).read_bytes()


def test_a_run_renders_what_the_evaluation_saves(trained, capsys):
    from pp_cl import evaluate_run, load

    run = load(trained[1])
    images = [run.render(camera).colour for camera in run.cameras("test")]
    assert all(image.shape == (24, 24, 3) and image.dtype == np.float32 for image in images)
    result = evaluate_run(trained[1], save_images=True)
    assert result == json.loads((trained[1] / "eval" / "metrics.json").read_text())
    for i, image in enumerate(images):
        saved = read_rgba(trained[1] / "eval" / "images" / f"r_{i}.png")[..., :3]
        np.testing.assert_array_equal(saved, to_8bit(image))
        np.testing.assert_array_equal(trained[0].render(trained[0].cameras()[i]).colour, image)


def test_the_border_of_an_image_is_as_bright_as_the_background_within(trained):
    run = pp_cl.load(trained[1])
    camera = run.cameras("test")[0].resized(64, 64)
    camera = replace(camera, fx=camera.fx / 3, fy=camera.fy / 3)  # the ball covers the middle only
    image = to_8bit(run.render(camera).colour).astype(int)
    assert (np.abs(image[:8] - image[4, 4]) <= 1).all() and (image != image[4, 4]).any()
    run.renderer.margin = 0
    assert np.abs(to_8bit(run.render(camera).colour)[0, 0] - image[4, 4]).max() > 5


def test_depths_of_drawn_pixels_stay_on_the_surface(trained, monkeypatch):
    run = pp_cl.load(trained[1])
    camera, views = run.cameras("test")[0], []
    for side in (1, 2):
        monkeypatch.setattr(run.renderer, "supersampling", side)
        views.append(run.render(camera))
    single, four = views
    np.testing.assert_array_equal(four.alpha == 0, np.isinf(four.depth))
    both = np.minimum(single.alpha, four.alpha) > 0.9
    apart = np.abs(single.median_depth[both] - four.median_depth[both])
    assert both.sum() > 20 and np.median(apart) < 0.2 * run.model.grid.voxel_size
    assert abs(single.alpha.mean() - four.alpha.mean()) < 0.02


def test_a_finished_run_is_left_alone_and_steps_are_told(scene, trained, tmp_path):
    steps = []

    def on_step(step, row):
        steps.append((step, row and row["psnr"]))

    out = tmp_path / "run"
    run = pp_cl.train_scene(scene, out, iterations=6, points=500, downscale=2, on_step=on_step)
    assert run.header["finished"] and [step for step, _ in steps] == [1, 2, 3, 4, 5, 6]
    assert [psnr is not None for _, psnr in steps] == [False] * 5 + [True]
    pp_cl.train_scene(scene, out, iterations=6, on_step=on_step)
    assert len(steps) == 6


def test_wrong_words_are_refused(scene, tmp_path):
    with pytest.raises(TypeError, match="no iteration; it has iterations, "):
        pp_cl.train_scene(scene, tmp_path / "run", iteration=5)
    with pytest.raises(pp_cl.UserError, match="settings: unknown key 'train.x'"):
        pp_cl.train_scene(scene, tmp_path / "run", settings={"train.x": 1})
    with pytest.raises(AttributeError):
        _ = pp_cl.trains
    assert not (tmp_path / "run").exists()


def test_the_package_and_its_help_need_no_opencl():
    code = "import sys, pp_cl, pp_cl.cli\ntry: pp_cl.cli.main(['train', '--help'])\n"
    code += "except SystemExit: pass\nassert 'pyopencl' not in sys.modules\n"
    code += "assert 'numpy' not in sys.modules\nassert set(pp_cl.__all__) <= set(dir(pp_cl))"
    root = Path(__file__).parents[1]
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root, stdout=subprocess.DEVNULL)


def test_a_folder_has_one_training_at_a_time(scene, tmp_path):
    out = tmp_path / "run"
    with RunFolder(out).owned():
        error = failure(*arguments(scene, out))
        assert f"{out}: process {os.getpid()} on {socket.gethostname()} trains into it" in error
    assert not (out / "config.json").exists(), "nothing was written beside the owner's"
    assert main(arguments(scene, out, train__iterations=2)) == 0
    assert not (out / ".pp-cl.owner").exists()


def test_a_folder_that_went_on_since_it_was_looked_at(scene, tmp_path, monkeypatch):
    out, folder = tmp_path / "run", RunFolder(tmp_path / "run")
    config = run_config(folder, scene, None, [("scene.downscale", 2, "test")])
    for key, value in (SETTINGS | {"train.iterations": 3}).items():
        assign(config, key, value, "test")
    late, early = (open_training(open_device(), folder, config, None) for _ in range(2))
    early.run()
    before = (out / "checkpoint.npz").read_bytes()
    with pytest.raises(UserError, match="another training has gone on to step 3"):
        late.run()
    assert (out / "checkpoint.npz").read_bytes() == before
