import os
import re
import shutil
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.browser import new_page
from support.scenes import ball_colour, write_ball_scene
from support.viewing import wait

from pp_cl.files.image import read_rgba
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import load
from pp_studio.export import hull, result
from pp_studio.export.gaussians import CONSTANT
from pp_studio.export.hull import hull_gaussians
from pp_studio.export.result import begin_result, write_model, write_result


def shown(folder):
    """(The page's text, the files that it names)."""
    text = (folder / "index.html").read_text("utf-8")
    assert "<!--" not in text
    return text, set(re.findall(r'(?:src|href|content)="([\w.]+\.\w+)"', text))


def test_before_the_training_it_shows_cameras_and_masks(tmp_path):
    scene = tmp_path / "scene"
    write_ball_scene(scene)
    (scene / "capture").mkdir()
    folder = tmp_path / "made"
    begin_result(folder)
    facts = {"scene": str(scene), "told": ["poses: 7 of 9 images"], "state": "3 minutes left"}
    write_result(folder, "Ball", "video.mp4", **facts)
    text, named = shown(folder)
    assert named == {"cameras.png"} and "poses: 7 of 9 images" in text and "3 minutes" in text
    drawn = read_rgba(folder / "cameras.png")
    assert drawn.shape == (500, 1000, 4) and drawn[..., :3].min() < 100
    assert text.count("still to come") == 3  # model, video and evaluation
    for name in ("box.png", "masks.png"):
        shutil.copy(folder / "cameras.png", scene / "capture" / name)
    write_result(folder, "Ball", "video.mp4", scene=str(scene))
    assert shown(folder)[1] == {"cameras.png", "masks.png"}


@pytest.fixture(scope="module")
def begun(runs, tmp_path_factory):
    """(Folder of a result before its training, with the hull's model; {facts for write_result})."""
    scene, folder = runs.ball(views=12, size=60), tmp_path_factory.mktemp("result") / "made"
    begin_result(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hull, "POINTS", 10_000)  # few enough for a processor to draw at once
        write_model(folder, *hull_gaussians(scene), "Ball")
    return folder, {"scene": scene, "state": "3 minutes left"}


def open_page(folder, facts):
    """A new_page() of the result, rewritten first so that its title is a new one."""
    write_result(folder, "Ball", "video.mp4", **facts)
    return new_page((folder / "index.html").as_uri())


def test_an_open_page_renews_itself_and_keeps_the_look(begun):
    folder, facts = begun
    text = "document.documentElement?.textContent ?? ''"  # works while the page reloads, too
    with open_page(folder, facts) as page:
        model = "document.querySelector('iframe').src"
        assert page.evaluate(model).endswith("/model.html")
        time.sleep(1)
        page.drag((300, 300), [(12, 3)] * 10)
        wait(lambda: page.evaluate("location.hash").startswith("#eye="))
        look = page.evaluate("location.hash")
        facts = facts | {"told": ["a new line"]}
        write_result(folder, "Ball", "video.mp4", **facts)
        wait(lambda: "a new line" in page.evaluate(text))
        assert page.evaluate("location.hash") == look and page.evaluate(model).endswith(look)
        write_result(folder, "Ball", "video.mp4", **facts | {"state": "", "told": ["the last"]})
        wait(lambda: "the last" in page.evaluate(text))
        for _ in range(2):  # one that is done asks once, and then for no newer version
            page.asked.clear()
            time.sleep(4)
            page.evaluate("1")
        assert not page.asked and not page.wrong


TOUCH = {"enabled": True, "maxTouchPoints": 2}
PHONE = {"width": 390, "height": 740, "deviceScaleFactor": 1, "mobile": True}


def test_without_its_folder_the_page_says_so(begun, tmp_path):
    """A browser would show its own page for a missing file in place of the model."""
    folder, facts = begun
    for told in (facts["state"], ""):
        write_result(folder, "Ball", "video.mp4", scene=facts["scene"], state=told)
        with new_page((folder / "index.html").as_uri()) as page:
            assert "send the whole folder" not in page.evaluate("document.body.innerText")
        shutil.copy(folder / "index.html", tmp_path / "index.html")
        with new_page((tmp_path / "index.html").as_uri()) as page:
            wait(lambda: "send the whole folder" in page.evaluate("document.body.innerText"))
            assert not page.evaluate("document.querySelector('iframe')")


def test_on_a_phone_one_finger_scrolls_past_the_model_and_turns_it(begun):
    folder, facts = begun
    with open_page(folder, facts) as page:
        page.call("Emulation.setDeviceMetricsOverride", **PHONE)
        page.call("Emulation.setTouchEmulationEnabled", **TOUCH)
        page.call("Page.reload")
        wait(lambda: page.evaluate("document.readyState") == "complete")
        time.sleep(1)

        def swipe(across, down):
            steps = np.linspace(0, 1, 9)[:, None]
            for x, y in (190, 300) + steps * (across, down):
                kind = "touchMove" if (x, y) != (190, 300) else "touchStart"
                touches = [{"x": x, "y": y}]
                page.call("Input.dispatchTouchEvent", type=kind, touchPoints=touches)
            page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

        swipe(-120, 0)
        wait(lambda: page.evaluate("location.hash").startswith("#eye="))
        assert page.evaluate("scrollY") == 0
        look = page.evaluate("location.hash")
        swipe(0, -200)
        wait(lambda: page.evaluate("scrollY") > 100)
        assert page.evaluate("location.hash") == look and not page.wrong


def test_a_hull_has_the_colours_of_its_photographs(runs):
    gaussians, cameras = hull_gaussians(runs.ball(views=12, size=60))
    assert [(camera.width, camera.height) for camera in cameras] == [(60, 60)] * 12
    positions = gaussians.table["position"] + gaussians.origin
    radii = np.linalg.norm(positions, axis=1)
    assert 0.75 < np.median(radii) < 0.95  # the ball's radius is 0.8
    surface = 0.8 * positions / radii[:, None]
    is_seen = np.abs(surface[:, 2]) < 0.5  # the cameras are above it, all around
    wrong = 0.5 + CONSTANT * gaussians.table["harmonics"][:, 0] - ball_colour(surface)
    assert np.abs(wrong[is_seen]).mean() < 0.06
    normals = Rotation.from_quat(np.roll(gaussians.table["turn"], -1, axis=1)).apply([0, 0, 1])
    assert np.quantile((normals * surface).sum(1) / 0.8, 0.05) > 0.8


@pytest.fixture
def trained(run_folder, session_device, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    shutil.rmtree(folder / "eval", ignore_errors=True)
    os.utime(folder / "checkpoint.npz", ns=(10**18, 10**18))
    return load(folder, session_device)


def test_what_comes_later_takes_its_place(trained, tmp_path, monkeypatch):
    folder, pages = tmp_path / "made", []
    for name in ("fitted", "first"):
        monkeypatch.setattr(result, f"{name}_gaussians", lambda _, name=name: name)
    monkeypatch.setattr(result, "page_text", lambda of, *_: pages.append(of) or "the model")
    begin_result(folder)
    write_result(folder, "Ball", "video.mp4", run=trained, split="test")
    text, named = shown(folder)
    assert named == {"model.html", "thumbnail.png"} and "<title>Ball</title>" in text
    assert text.count("still to come") == 2
    (folder / "video.mp4").write_bytes(b"film")
    os.utime(folder / "video.mp4", ns=(10**18 - 1,) * 2)  # older than the checkpoint
    write_result(folder, "Ball", "video.mp4", run=trained, split="test")
    assert shown(folder)[1] == {"model.html", "thumbnail.png"} and pages == ["first"]
    for name in ("video.mp4", "splat.ply"):
        (folder / name).write_bytes(b"made")
    measured = RunFolder(trained.folder.path).evaluation("test")
    measured.mkdir(parents=True)
    (measured / "metrics.json").write_text(
        '{"mean": {"psnr": 30.5, "ssim": 0.9, "lpips": 0.1}, "per_image": [1, 2], "size": [48, 40]}'
    )
    shutil.copy(folder / "thumbnail.png", measured / "comparison.png")
    write_result(folder, "Ball", "video.mp4", run=trained, split="test")
    text, named = shown(folder)
    assert named == {"model.html", "video.mp4", "splat.ply", "views.png", "thumbnail.png"}
    assert (
        "30.5 (mean of 2 views of 48x40)" in text
        and "LPIPS" in text
        and "still to come" not in text
    )
    assert pages == ["first", "fitted"]  # the model's page shows the splat now
    write_result(folder, "Ball", "video.mp4", run=trained, split="test")
    assert len(pages) == 2
