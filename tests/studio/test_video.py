import re
import subprocess
import sys

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from pp_cl.errors import UserError
from pp_studio.video import LOOPED, check_video, write_video


def frames(height=50, width=64, channels=3, count=9):
    for i in range(count):
        frame = np.full((height, width, channels), 255, np.uint8)
        frame[..., :3] = (40, 130, 200)
        frame[10:40, 4 * i : 4 * i + 20, :3] = (220, 90, 30)
        if channels == 4:
            frame[:, 50:, 3] = 0
        yield frame


@pytest.mark.parametrize("suffix", ["mp4", "webm"])
@pytest.mark.parametrize("size", [(50, 64), (51, 65)])
def test_a_video_is_read_back(tmp_path, suffix, size):
    path = tmp_path / f"video.{suffix}"
    write_video(path, frames(*size), 12.5)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    if suffix == "mp4":  # a page can play it before it is complete
        content = path.read_bytes()
        assert 0 < content.index(b"moov") < content.index(b"mdat")
    with imageio.get_reader(str(path)) as reader:
        data, read = reader.get_meta_data(), list(reader.iter_data())
    assert len(read) == 9 and data["fps"] == 12.5
    assert data["size"] == (size[1] + size[1] % 2, size[0] + size[0] % 2)
    assert data["duration"] == pytest.approx(9 / 12.5, abs=0.1)
    for got, expected in zip(read, frames(*size), strict=True):
        difference = np.abs(got[: size[0], : size[1]].astype(int) - expected)
        assert difference.mean() < 6


@pytest.mark.parametrize("suffix", ["mp4", "webm"])
def test_colours_come_back_as_players_show_them(tmp_path, suffix):
    path, size = tmp_path / f"video.{suffix}", (48, 64)
    colours = np.array([(200, 60, 30), (30, 180, 60), (40, 70, 220), (230, 200, 40), (128,) * 3])
    width = size[1] // len(colours)
    frame = np.zeros((*size, 3), np.uint8)
    for i, colour in enumerate(colours):
        frame[:, i * width : (i + 1) * width] = colour
    write_video(path, iter([frame] * 5), 10)
    log = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", str(path)],
        capture_output=True,
        text=True,
        check=False,
    ).stderr
    assert re.search(r"yuv420p\(tv, bt709[,)]", log), log
    read = imageio_ffmpeg.read_frames(
        str(path), output_params=["-vf", "scale=in_color_matrix=bt709:out_range=pc"]
    )
    next(read)
    decoded = np.frombuffer(next(read), np.uint8).reshape(*size, 3)
    for i, colour in enumerate(colours):
        middle = decoded[size[0] // 2, i * width + width // 2]
        assert np.abs(middle.astype(int) - colour).max() <= 3, (i, middle)


@pytest.mark.parametrize("suffix", LOOPED)
@pytest.mark.parametrize("fps", (24, 12.5))
def test_a_video_for_pages_lasts_as_long_as_it_should(tmp_path, suffix, fps):
    """A gif's frames last whole hundredths of a second."""
    write_video(tmp_path / f"video.{suffix}", frames(count=9), fps)
    lasts = []
    with Image.open(tmp_path / f"video.{suffix}") as video:
        for i in range(video.n_frames):
            video.seek(i)
            video.load()
            lasts.append(video.info["duration"])
        assert video.info["loop"] == 0 and video.size == (64, 50)
    assert len(lasts) == 9 and sum(lasts) == pytest.approx(9000 / fps, abs=5.001)


def test_a_transparent_gif_leaves_no_trails(tmp_path):
    write_video(tmp_path / "12:30.gif", moving_square(), 10)
    with Image.open(tmp_path / "12:30.gif") as image:
        for expected in moving_square():
            shown = np.asarray(image.convert("RGBA"))[..., 3] > 0
            np.testing.assert_array_equal(shown, expected[..., 3] > 0)
            image.seek(min(image.tell() + 1, image.n_frames - 1))


def moving_square():
    for i in range(4):
        frame = np.zeros((32, 32, 4), np.uint8)
        frame[8:16, 6 * i : 6 * i + 8] = (200, 60, 30, 255)
        yield frame


def test_webm_keeps_what_is_transparent(tmp_path):
    path = tmp_path / "video.webm"
    write_video(path, frames(channels=4), 10)
    decoder = ["-c:v", "libvpx-vp9"]
    reader = imageio_ffmpeg.read_frames(
        str(path), pix_fmt="rgba", bits_per_pixel=32, input_params=decoder
    )
    width, height = next(reader)["size"]
    alpha = np.frombuffer(next(reader), np.uint8).reshape(height, width, 4)[..., 3]
    assert (alpha[:, 52:] < 30).all() and (alpha[:, :48] > 225).all()


@pytest.mark.unix
def test_a_full_disk_is_one_line_and_leaves_no_video(tmp_path):
    """ffmpeg does not report it. A limit on the size of files, in a process of its own, imitates
    it.
    """
    script = (
        "import resource, signal, sys\n"
        "import numpy as np\n"
        "from pathlib import Path\n"
        "from pp_cl.errors import UserError\n"
        "from pp_studio.video import write_video\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "noise = np.random.default_rng(0).integers(0, 255, (9, 96, 96, 3), dtype=np.uint8)\n"
        "try:\n"
        "    write_video(Path(sys.argv[1]), noise, 10)\n"
        "except UserError as error:\n"
        "    print(error)\n"
    )
    words = [sys.executable, "-c", script, str(tmp_path / "video.mp4")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert "video.mp4: cannot be written" in done.stdout and done.stderr == ""
    assert list(tmp_path.iterdir()) == []


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match=r"pip install imageio imageio-ffmpeg"):
        check_video("mp4")
    check_video("gif")
