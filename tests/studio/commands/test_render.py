import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import imageio.v2 as imageio
import numpy as np
import OpenEXR
import pytest
from filelock import FileLock
from support.refused import failure

from pp_cl.cli import main
from pp_cl.files.atomic import MANIFEST
from pp_cl.files.image import read_rgba
from pp_cl.metrics.psnr_ssim import psnr
from pp_studio.export import render_video
from pp_studio.export.gaussians import first_gaussians


@pytest.fixture(scope="module")
def trained(finished):
    return str(finished)


def test_a_video_is_what_its_name_says_and_leaves_nothing_beside_it(trained, tmp_path, capsys):
    video = tmp_path / "new" / "video.mp4"
    words = ["render", trained, "--out", str(video), "--seconds", "0.5", "--fps", "12"]
    assert main([*words, "--size", "48x32"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == f"wrote {video}"
    assert list(video.parent.iterdir()) == [video]
    with imageio.get_reader(str(video)) as read:
        data = read.get_meta_data()
        assert data["size"] == (48, 32) and data["fps"] == 12
        frames = [frame.astype(int) for frame in read.iter_data()]
    assert len(frames) == 6 and np.abs(frames[0] - frames[3]).max() > 20


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_a_video_whose_frames_would_fill_the_memory_is_not_begun(trained, tmp_path, suffix):
    """Pillow keeps all frames: 200 of 960x540 took 450 MB as WebP; by imageio, 46 MB as MP4."""
    out = tmp_path / f"video.{suffix}"
    words = ("render", trained, "--out", out, "--seconds", "60", "--size", "1920x1080")
    assert "--format mp4" in failure(*words)
    assert not list(tmp_path.iterdir())


def test_a_video_that_was_interrupted_goes_on(trained, tmp_path, capsys, monkeypatch):
    words = ["render", trained, "--out", str(tmp_path / "video.gif")]
    words += ["--seconds", "1", "--fps", "4"]
    write, done = render_video.write_png, []

    def stopping(path, image):
        if len(done) == 2:
            raise KeyboardInterrupt
        write(path, image)
        done.append(path)

    with monkeypatch.context() as patch:
        patch.setattr(render_video, "write_png", stopping)
        assert main(words) == 130
    assert not (tmp_path / "video.gif").exists()
    with FileLock(done[0].parent / ".pp-cl.lock"):
        assert "video.gif.frames: another process" in failure(*words)
    assert main(words) == 0
    assert "rendered 2 of 4 frames" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [tmp_path / "video.gif"]
    assert main([*words, "--background", "black"]) == 0  # other options: no frame is reused
    assert "rendered 4 of 4 frames" in capsys.readouterr().out
    done[0].parent.mkdir()
    (done[0].parent / ".mine.png").write_bytes(b"mine")
    assert main(words) == 0 and (done[0].parent / ".mine.png").read_bytes() == b"mine"
    with imageio.get_reader(str(tmp_path / "video.gif")) as read:
        assert read.get_length() == 4


def test_sizes_have_folders_of_their_own_and_need_no_scene(trained):
    run = Path(trained)
    run = shutil.copytree(run, run.with_name("run \udcff"))
    config = json.loads((run / "config.json").read_text())
    config["scene"]["path"] = "/nowhere/at/all"
    (run / "config.json").write_text(json.dumps(config))
    words = ["render", str(run), "--seconds", "0.1", "--fps", "10"]
    for more in ([], ["--size", "32x32"], ["--format", "png"], ["--path", "spiral"]):
        assert main([*words, *more]) == 0
    names = {path.name for path in (run / "render").iterdir() if path.name[0] != "."}
    large = {"orbit_480x480.mp4", "orbit_480x480", "spiral_480x480.mp4"}
    assert names == large | {"orbit_32x32.mp4"}
    assert "/nowhere" in failure(*words[:2], "--path", "test")
    assert "every run has are orbit and spiral" in failure(*words[:2], "--path", "circle")
    assert "choose another" in failure(*words[:2], "--format", "exr")


def test_frames_that_are_there_are_not_rendered_again(trained, tmp_path, capsys):
    words = ["render", trained, "--out", str(tmp_path / "o"), "--seconds", "1", "--fps", "4"]
    assert main(words) == 0

    def files():
        return {p.name: p.read_bytes() for p in (tmp_path / "o").iterdir() if p.name != MANIFEST}

    whole = files()
    (tmp_path / "o" / "00002.png").unlink()
    (tmp_path / "o" / ".00003.png.999999999.pp-cl.tmp").write_bytes(b"half")
    capsys.readouterr()
    assert main(words) == 0
    assert "rendered 1 of 4 frames" in capsys.readouterr().out
    assert files() == whole
    error = failure(*words, "--background", "black")
    assert "holds frames of another model, path or style" in error
    assert files() == whole


def test_what_frames_cost_decides_how_they_are_drawn(trained, tmp_path, monkeypatch, capsys):
    """The clock advances only while images with more pixels are rendered."""
    clock, real, asked = [0.0], render_video.render_large, []

    def slow(run, camera, *, most, **options):
        clock[0] += {4: 10, 2: 5}[most]
        asked.append(most)
        return real(run, camera, most=most, **options)

    monkeypatch.setattr(render_video, "render_large", slow)
    monkeypatch.setattr(render_video, "time", Mock(perf_counter=lambda: clock[0]))
    words = ["render", trained, "--format", "png", "--seconds", "1", "--fps", "4"]
    words += ["--size", "96x96"]

    def frames(name, minutes):
        asked.clear()
        assert main([*words, "--out", str(tmp_path / name), "--minutes", minutes]) == 0
        return [read_rgba(path) for path in sorted((tmp_path / name).glob("*.png"))]

    whole = frames("whole", "1")
    assert set(asked) == {4} and "frames are" not in capsys.readouterr().out
    coarser = frames("coarser", "0.5")
    assert asked[-4:] == [2] * 4 and "otherwise they would take 0.7 min" in capsys.readouterr().out
    frames("none", "0.01")  # no Gaussians have been fitted
    assert asked[-4:] == [2] * 4
    monkeypatch.setattr(render_video, "kept_gaussians", first_gaussians)
    gaussians = frames("gaussians", "0.01")
    assert asked == [4, 4, 2, 2] and "3D Gaussians" in capsys.readouterr().out
    assert len(whole) == len(coarser) == len(gaussians) == 4
    for frame, other in zip(whole, gaussians, strict=True):
        assert 20 < psnr(frame[..., :3], other[..., :3]) < 60
    (tmp_path / "gaussians/00002.png").unlink()
    again = frames("gaussians", "1")  # continues in the way it began
    assert asked == [] and "as they were begun" in capsys.readouterr().out
    np.testing.assert_array_equal(again, gaussians)


def test_transparent_frames_and_colours(trained, tmp_path):
    words = ["render", trained, "--path", "test", "--format", "png"]
    images = {}
    for name in ("transparent", "black", "0,255,0"):
        out = str(tmp_path / name)
        assert main([*words, "--background", name, "--out", out]) == 0
        images[name] = read_rgba(tmp_path / name / "00000.png").astype(int)
    alpha = images["transparent"][..., 3]
    assert alpha.min() == 0 and alpha.max() > 200
    nothing = alpha == 0
    assert (images["0,255,0"][nothing][:, :3] == (0, 255, 0)).all()
    assert (images["black"][nothing][:, :3] == 0).all()


def test_exr_frames_hold_alpha_depth_and_features(trained, tmp_path):
    words = ["render", trained, "--path", "test", "--format", "exr", "--features", "--samples", "4"]
    assert main([*words, "--out", str(tmp_path / "e")]) == 0
    file = OpenEXR.File(str(tmp_path / "e" / "00000.exr"), separate_channels=True)
    channels = {name: channel.pixels for name, channel in file.channels().items()}
    assert len(channels) == 6 + 16 and channels["R"].shape == (24, 24)
    there = channels["A"] > 0.5
    distance = 4.0  # from the cameras to the ball's centre
    assert there.any() and (np.abs(channels["Z"][there] - distance) < 1).all()
    assert np.isinf(channels["Z"][channels["A"] == 0]).all()
