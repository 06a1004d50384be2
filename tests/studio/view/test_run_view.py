import contextlib
import io
import json
import os
import time

import numpy as np
import pytest
from PIL import Image
from support.scenes import ring_cameras
from support.viewing import drawing, tab, wait

from pp_cl.config import load_config
from pp_cl.files.image import to_8bit
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import load
from pp_cl.scene.readers.camera_file import read_cameras
from pp_cl.session.training import open_training
from pp_studio.export.gaussians import fitted_gaussians
from pp_studio.large import render_large
from pp_studio.view.drawing import draw
from pp_studio.view.model_page import STILL, ModelPage
from pp_studio.view.run_view import RunView, shown_training

CAMERA = ring_cameras(3, 96)[2]  # for tabs: finer than the training's images, so JPEG loses less


@pytest.fixture
def view(served, dev, copied):
    run_view = RunView(served[0], dev, RunFolder(copied))
    run_view.look()
    return run_view


@contextlib.contextmanager
def looking(view, address, camera=CAMERA):
    """A Tab at a camera, before any rendering of it is drawn."""
    with tab(address) as opened:
        opened.look(camera, view.page._space)
        wait(lambda: any(np.allclose(t.camera.eye, camera.eye) for t in view.page._tabs.values()))
        yield opened


def drawn(view):
    time.sleep(1.5 * STILL)
    while view.page.draw_next():
        pass


def like(view, camera, **look):
    """A check that an image equals draw()'s, apart from JPEG's losses."""
    expected, _ = draw(view.page.run, view.page._views, camera, **look)
    return lambda image: image.shape == expected.shape and np.abs(image - expected).mean() < 4


def test_a_moving_camera_gets_drafts_and_one_at_rest_the_full_image(view, served, monkeypatch):
    with looking(view, served[1]) as opened:
        monkeypatch.setattr("pp_studio.view.model_page.STILL", 1e9)
        assert view.page.draw_next() and not view.page.draw_next()
        assert opened.image().shape == (24, 24, 3)
        monkeypatch.setattr("pp_studio.view.model_page.STILL", 0)
        assert view.page.draw_next() and not view.page.draw_next()
        opened.image(like(view, CAMERA))
        view.page.renew()
        assert view.page.draw_next()


def test_switches_change_what_is_drawn(view, served):
    changes = (
        ("Show depth", True, {"show": "depth"}),
        ("Brightness", -2.0, {"show": "depth", "exposure": -2.0}),
        ("Reset", True, {"show": "depth"}),
        ("Show", "colour", {}),
        ("Points shown, %", 20, {"share": 0.2}),
        ("Points shown, %", -7, {"share": 0.01}),  # a value beyond the slider
    )
    checks = [like(view, CAMERA, **look) for _, _, look in changes]
    with looking(view, served[1]) as opened, drawing(view.page):
        for (label, value, _), check in zip(changes, checks, strict=True):
            if label == "Show depth":  # a command with a key
                opened.send("CommandTriggerMessage", uuid=opened.handles[label]["uuid"])
            else:
                opened.set(label, value)
            opened.image(check)


def test_the_image_is_saved_as_it_is(view, served):
    with looking(view, served[1]) as opened, drawing(view.page):
        opened.set("Save image", True)
        name, content = opened.file()
    image = np.array(Image.open(io.BytesIO(content)))
    assert name == f"{view._folder.path.name}_step_40_colour.png"
    rendering = to_8bit(render_large(view.page.run, CAMERA).colour)
    assert np.abs(image - rendering.astype(int)).max() <= 1  # the camera came by float64 words


def test_a_path_is_one_that_render_takes(view, served, tmp_path):
    keys = ring_cameras(3, 48)
    with tab(served[1]) as opened:
        for i, camera in enumerate((*keys, keys[0])):
            opened.look(camera, view.page._space)
            eye = camera.eye
            wait(lambda: view.page._tabs)
            wait(lambda eye=eye: np.allclose(next(iter(view.page._tabs.values())).camera.eye, eye))
            opened.set("Add this camera", True)
            wait(lambda i=i: len(view.page._keys) == i + 1)
        opened.set("Remove the last", True)
        wait(lambda: len(view.page._keys) == 3)
        opened.set("Seconds", 2)
        wait(lambda: view.page._seconds.value == 2)
        opened.set("Save path.json", True)
        name, content = opened.file()
    (tmp_path / name).write_bytes(content)
    cameras = read_cameras(tmp_path / name)
    assert len(cameras) == 60
    np.testing.assert_allclose(cameras[0].pose, keys[0].pose, atol=1e-6)
    np.testing.assert_allclose(cameras[-1].pose, keys[2].pose, atol=1e-6)
    assert {(c.width, c.height) for c in cameras} == {(cameras[0].width,) * 2}
    np.testing.assert_allclose(cameras[30].fx / cameras[30].width, CAMERA.fx / 96)


def test_tabs_take_turns_and_nothing_is_drawn_for_a_closed_one(view, served):
    with looking(view, served[1]) as opened, looking(view, served[1]) as other:
        wait(lambda: len(view.page._tabs) == 2)
        drawn(view)
        assert opened.image().shape == other.image().shape
        other.look(CAMERA, view.page._space)
    wait(lambda: not view.page._tabs)
    assert not view.page.draw_next()


def test_a_rendering_that_is_not_wanted_any_more_is_given_up(view, served, monkeypatch):
    with looking(view, served[1]) as opened:
        [page_tab] = view.page._tabs.values()

        def move(*_, on_part, **__):
            page_tab.moved = time.monotonic()
            on_part()

        monkeypatch.setattr("pp_studio.view.model_page.STILL", 0)
        with monkeypatch.context() as patch:
            patch.setattr("pp_studio.view.model_page.draw", move)
            assert view.page.draw_next()
        assert view.page.draw_next()  # this one is completed
        opened.image(like(view, CAMERA))


def test_the_browser_draws_the_gaussians_where_drafts_are_slow(served, dev, copied, monkeypatch):
    table, *_ = fitted_gaussians(load(copied, dev))
    view = RunView(served[0], dev, RunFolder(copied))
    view.look()
    monkeypatch.setattr("pp_studio.view.model_page.STILL", 1e9)
    with looking(view, served[1]):
        [page_tab] = view.page._tabs.values()
        assert page_tab.splat.visible  # until a rendering is drawn
        assert page_tab.splat.buffer.shape[0] == len(table)
        assert view.page.draw_next() and not page_tab.splat.visible
        view.page._took = 1e9
        page_tab.moved = time.monotonic()
        assert not view.page.draw_next(), "no draft is drawn"
        monkeypatch.setattr("pp_studio.view.model_page.STILL", 0)
        assert view.page.draw_next() and not page_tab.splat.visible
        os.utime(copied / "checkpoint.npz", ns=(1, 1))
        view.look()
        assert page_tab.splat is None, "they are of the checkpoint before"


def test_a_new_checkpoint_is_taken_up_and_a_broken_one_is_not(served, dev, copied):
    whole = (copied / "checkpoint.npz").read_bytes()
    (copied / "checkpoint.npz").unlink()
    view = RunView(served[0], dev, RunFolder(copied))
    view.look()
    assert "waiting" in view.told.content and view.page is None
    (copied / "checkpoint.npz").write_bytes(whole[:-100])
    view.look()
    assert "cannot be read" in view.told.content and view.page is None
    (copied / "checkpoint.npz").write_bytes(whole)
    view.look()
    assert view.told.content == ""
    first = view.page.run
    with looking(view, served[1]):
        drawn(view)
        view.look()
        assert view.page.run is first and not view.page.draw_next()
        os.utime(copied / "checkpoint.npz", ns=(1, 1))
        view.look()
        assert view.page.run is not first and view.page.draw_next()
        (copied / "checkpoint.npz").write_bytes(whole[:-100])
        second = view.page.run
        view.look()
        assert "cannot be read" in view.told.content and view.page.run is second


def test_a_run_whose_images_are_gone_is_still_shown(served, dev, copied):
    config = json.loads((copied / "config.json").read_text())
    config["scene"]["path"] = "/nowhere/<i>[at]/all"
    (copied / "config.json").write_text(json.dumps(config))
    view = RunView(served[0], dev, RunFolder(copied))
    view.look()
    assert r"/nowhere/&lt;i&gt;\[at]/all" in view.told.content  # neither HTML nor a link
    with looking(view, served[1]) as opened:
        drawn(view)
        assert (opened.image() < 200).any()
        assert len([node for node in opened.nodes.values() if "fov" in node["props"]]) == 8
        opened.set("Show", "error")
        wait(lambda: view.page._show.value == "error")
        drawn(view)
        assert "photographs are not there" in view.page._status.content


@pytest.fixture
def training(dev, scene, tmp_path, runs):
    """A training of 15 steps in the folder run; the folder alone has the result of one without a
    page.
    """
    alone = runs.trained(tmp_path / "alone", scene, train__iterations=15)
    config = load_config(alone / "config.json")
    return open_training(dev, RunFolder(tmp_path / "run"), config, None)


def test_a_watched_training_has_the_same_bits(training, tmp_path):
    cameras, images = ring_cameras(5, 96), []
    with shown_training(training) as (address, on_step), tab(address) as opened:
        page = page_of(on_step)

        def follow(step, row):
            opened.look(cameras[step % 5], page._space)
            opened.set("Show", page._show.options[step // 3 % 7])
            deadline = time.monotonic() + 0.1
            while time.monotonic() < deadline:
                on_step(step, row)
                time.sleep(0.01)
            images.append(page.run.header["step"])

        training.run(follow)
        shapes = {opened.image().shape[:2] for _ in range(3)}
    assert images == list(range(1, 16)) and max(map(max, shapes)) <= 48
    assert arrays(tmp_path / "run") == arrays(tmp_path / "alone")


def page_of(on_step) -> ModelPage:
    return next(
        c.cell_contents for c in on_step.__closure__ if isinstance(c.cell_contents, ModelPage)
    )


def arrays(folder):
    with np.load(folder / "checkpoint.npz") as stored:
        return {name: stored[name].tobytes() for name in stored.files if stored[name].ndim}


def test_a_page_that_fails_does_not_end_a_training(training, monkeypatch):
    monkeypatch.setattr(ModelPage, "draw_next", lambda self: 1 / 0)
    with shown_training(training) as (_, on_step):
        with pytest.warns(UserWarning, match="division"):
            on_step(1, None)
        on_step(2, None)


def test_a_training_keeps_two_thirds_of_the_time(training, monkeypatch):
    times = []

    def draw_next(self):
        times.append(time.monotonic())
        time.sleep(0.05)
        return True

    monkeypatch.setattr(ModelPage, "draw_next", draw_next)
    with shown_training(training) as (_, on_step):
        end = time.monotonic() + 1
        while time.monotonic() < end:
            on_step(1, None)
    assert 2 <= len(times) <= 7 and np.diff(times).min() > 0.149
