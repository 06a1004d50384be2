"""Films have the frames, the size and the speed that were asked for."""

import subprocess
import sys

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from pp_cl.errors import UserError
from pp_cl.files.video import LOOPED, check_video, write_video


def frames(height=50, width=64, channels=3, count=9):
    """Frames of a square that moves on a colour."""
    for i in range(count):
        frame = np.full((height, width, channels), 255, np.uint8)
        frame[..., :3] = (40, 130, 200)
        frame[10:40, 4 * i : 4 * i + 20, :3] = (220, 90, 30)
        if channels == 4:
            frame[:, 50:, 3] = 0
        yield frame


@pytest.mark.parametrize("suffix", ["mp4", "webm"])
@pytest.mark.parametrize("size", [(50, 64), (51, 65)])
def test_a_film_is_read_back(tmp_path, suffix, size):
    path = tmp_path / f"film.{suffix}"
    write_video(path, frames(*size), 12.5)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    with imageio.get_reader(str(path)) as reader:
        data, read = reader.get_meta_data(), list(reader.iter_data())
    assert len(read) == 9 and data["fps"] == 12.5
    assert data["size"] == (size[1] + size[1] % 2, size[0] + size[0] % 2)
    assert data["duration"] == pytest.approx(9 / 12.5, abs=0.1)
    for got, expected in zip(read, frames(*size), strict=True):
        difference = np.abs(got[: size[0], : size[1]].astype(int) - expected)
        assert difference.mean() < 6


@pytest.mark.parametrize("suffix", LOOPED)
def test_a_film_for_pages_loops_at_its_speed(tmp_path, suffix):
    write_video(tmp_path / f"film.{suffix}", frames(), 12.5)
    with Image.open(tmp_path / f"film.{suffix}") as film:
        film.load()
        assert film.n_frames == 9 and film.size == (64, 50)
        assert film.info["duration"] == 80 and film.info["loop"] == 0


def test_webm_keeps_what_is_transparent(tmp_path):
    path = tmp_path / "film.webm"
    write_video(path, frames(channels=4), 10)
    decoder = ["-c:v", "libvpx-vp9"]
    reader = imageio_ffmpeg.read_frames(
        str(path), pix_fmt="rgba", bits_per_pixel=32, input_params=decoder
    )
    width, height = next(reader)["size"]
    alpha = np.frombuffer(next(reader), np.uint8).reshape(height, width, 4)[..., 3]
    assert (alpha[:, 52:] < 30).all() and (alpha[:, :48] > 225).all()


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    with pytest.raises(UserError, match="film.mp4: cannot be written"):
        write_video(tmp_path / "missing" / "film.mp4", frames(), 10)


@pytest.mark.unix
@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_a_full_disk_is_one_line_and_leaves_no_film(tmp_path, suffix):
    """A limit on the size of a file stands for it, in a process of its own."""
    script = (
        "import resource, signal, sys\n"
        "import numpy as np\n"
        "from pathlib import Path\n"
        "from pp_cl.errors import UserError\n"
        "from pp_cl.files.video import write_video\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "noise = np.random.default_rng(0).integers(0, 255, (9, 96, 96, 3), dtype=np.uint8)\n"
        "try:\n"
        "    write_video(Path(sys.argv[1]), noise, 10)\n"
        "except UserError as error:\n"
        "    print(error)\n"
    )
    words = [sys.executable, "-c", script, str(tmp_path / f"film.{suffix}")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert f"film.{suffix}: cannot be written" in done.stdout and done.stderr == ""
    assert list(tmp_path.iterdir()) == []


def test_a_missing_package_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match="pip install imageio imageio-ffmpeg`"):
        check_video("mp4")
    check_video("gif")
