import os
import re
import shutil

import pytest
from support.scenes import write_ball_scene

from pp_cl.files.image import read_rgba
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import load
from pp_studio.export import result
from pp_studio.export.result import begin_result, write_result


def shown(folder):
    """(text of the page, the files that it names)."""
    text = (folder / "index.html").read_text("utf-8")
    assert "<!--" not in text
    return text, set(re.findall(r'(?:src|href|content)="([\w.]+\.\w+)"', text))


def test_before_the_training_it_shows_cameras_and_masks(tmp_path):
    scene = tmp_path / "scene"
    write_ball_scene(scene)
    (scene / "capture").mkdir()
    folder = tmp_path / "made"
    begin_result(folder)
    write_result(None, "test", folder, "video.mp4", ["poses: 7 of 9 images"], str(scene))
    text, named = shown(folder)
    assert named == {"cameras.png"} and "poses: 7 of 9 images" in text
    drawn = read_rgba(folder / "cameras.png")
    assert drawn.shape == (500, 1000, 4) and drawn[..., :3].min() < 100
    assert text.count("still to come") == 3  # the model, the video, the evaluation
    for name in ("box.png", "masks.png"):
        shutil.copy(folder / "cameras.png", scene / "capture" / name)
    write_result(None, "test", folder, "video.mp4", (), str(scene))
    assert shown(folder)[1] == {"cameras.png", "masks.png"}


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
    monkeypatch.setattr(result, "page_text", lambda run, of, title: pages.append(of) or "the model")
    begin_result(folder)
    write_result(trained, "test", folder, "video.mp4")
    text, named = shown(folder)
    assert named == {"model.html", "thumbnail.png"} and text.count("still to come") == 2
    (folder / "video.mp4").write_bytes(b"film")
    os.utime(folder / "video.mp4", ns=(10**18 - 1,) * 2)  # of the checkpoint before
    write_result(trained, "test", folder, "video.mp4")
    assert shown(folder)[1] == {"model.html", "thumbnail.png"} and pages == ["first"]
    for name in ("video.mp4", "splat.ply"):
        (folder / name).write_bytes(b"made")
    measured = RunFolder(trained.folder.path).evaluation("test")
    measured.mkdir(parents=True)
    (measured / "metrics.json").write_text(
        '{"mean": {"psnr": 30.5, "ssim": 0.9, "lpips": 0.1}, "per_image": [1, 2]}'
    )
    shutil.copy(folder / "thumbnail.png", measured / "comparison.png")
    write_result(trained, "test", folder, "video.mp4")
    text, named = shown(folder)
    assert named == {"model.html", "video.mp4", "splat.ply", "views.png", "thumbnail.png"}
    assert "30.5 (mean of 2 views)" in text and "LPIPS" in text and "still to come" not in text
    assert pages == ["first", "fitted"]  # the model's page is that of the splat now
    write_result(trained, "test", folder, "video.mp4")
    assert len(pages) == 2
