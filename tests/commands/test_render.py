"""`pp-cl render`: films and frames as asked for, what is taken up again, what is refused."""

import imageio.v2 as imageio
import numpy as np
import OpenEXR
import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.files.image import read_rgba


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder of a small run, as text."""
    folder = tmp_path_factory.mktemp("render")
    assert main(arguments(write_ball_scene(folder / "ball"), folder / "run")) == 0
    return str(folder / "run")


def test_a_film_of_an_orbit(trained, tmp_path, capsys):
    words = ["render", trained, "--out", str(tmp_path / "o"), "--seconds", "0.5", "--fps", "12"]
    assert main([*words, "--size", "48x32"]) == 0
    said = capsys.readouterr().out
    assert "rendered 6 of 6 frames" in said and str(tmp_path / "o.mp4") in said
    with imageio.get_reader(str(tmp_path / "o.mp4")) as film:
        data = film.get_meta_data()
        assert data["size"] == (48, 32) and data["fps"] == 12
        assert sum(1 for _ in film.iter_data()) == 6
    frames = [read_rgba(tmp_path / "o" / f"{i:05d}.png") for i in range(6)]
    assert all(frame.shape == (32, 48, 4) for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[3]).max() > 20
    assert read_rgba(tmp_path / "o.png").shape[2] == 4


def test_frames_that_are_there_are_not_rendered_again(trained, tmp_path, capsys):
    words = ["render", trained, "--out", str(tmp_path / "o"), "--seconds", "1", "--fps", "4"]
    words += ["--format", "png"]
    assert main(words) == 0
    whole = {p.name: p.read_bytes() for p in (tmp_path / "o").iterdir()}
    (tmp_path / "o" / "00002.png").unlink()
    (tmp_path / "o" / ".00003.png.999999999.tmp").write_bytes(b"half")
    capsys.readouterr()
    assert main(words) == 0
    assert "rendered 1 of 4 frames" in capsys.readouterr().out
    assert {p.name: p.read_bytes() for p in (tmp_path / "o").iterdir()} == whole
    assert main([*words, "--background", "black"]) == 2
    assert "holds frames of another model or path" in capsys.readouterr().err
    assert {p.name: p.read_bytes() for p in (tmp_path / "o").iterdir()} == whole


def test_the_test_views_are_what_eval_shows(trained, tmp_path):
    assert main(["eval", trained, "--save-images"]) == 0
    out = tmp_path / "views"
    assert main(["render", trained, "--path", "test", "--out", str(out), "--format", "png"]) == 0
    for i in range(2):
        saved = read_rgba(f"{trained}/eval/images/r_{i}.png")
        np.testing.assert_array_equal(read_rgba(out / f"{i:05d}.png"), saved)


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
    green = images["0,255,0"][..., 1] - images["black"][..., 1]
    assert np.abs(green - (255 - alpha)).max() <= 2


def test_exr_frames_hold_alpha_depth_and_features(trained, tmp_path):
    words = ["render", trained, "--path", "test", "--format", "exr", "--features", "--samples", "4"]
    assert main([*words, "--out", str(tmp_path / "e")]) == 0
    file = OpenEXR.File(str(tmp_path / "e" / "00000.exr"), separate_channels=True)
    channels = {name: channel.pixels for name, channel in file.channels().items()}
    assert len(channels) == 6 + 16 and channels["R"].shape == (24, 24)
    there = channels["A"] > 0.5
    distance = 4.0  # of the cameras from the ball's centre
    assert there.any() and (np.abs(channels["Z"][there] - distance) < 1).all()
    assert np.isinf(channels["Z"][channels["A"] == 0]).all()
    assert (tmp_path / "e.png").exists()


def test_a_sheet_of_a_spiral_and_a_file(trained, tmp_path):
    assert main(["render", trained, "--path", "spiral", "--seconds", "0.2", "--fps", "10"]) == 0
    words = ["--path", str(tmp_path / "path.json"), "--format", "gif", "--size", "32x32"]
    (tmp_path / "path.json").write_text(
        '{"camera_path": [{"fov": 40, "camera_to_world": [1,0,0,0, 0,1,0,0, 0,0,1,4, 0,0,0,1]}]}'
    )
    assert main(["render", trained, *words, "--out", str(tmp_path / "file")]) == 0
    assert (tmp_path / "file.gif").exists()


@pytest.mark.parametrize(
    "words, named",
    [
        (["--size", "0x32"], "--size 0x32"),
        (["--size", "large"], "--size large"),
        (["--fov", "nan"], "--fov nan"),
        (["--fps", "0"], "--fps 0"),
        (["--seconds", "-1"], "--seconds -1"),
        (["--seconds", "0.001"], "--seconds 0.001"),
        (["--samples", "3"], "--samples 3"),
        (["--background", "red"], "--background red"),
        (["--background", "transparent"], "mp4 keeps no alpha"),
        (["--features"], "--features"),
        (["--format", "avi"], "avi"),
        (["--path", "nowhere"], "nowhere"),
        (["--path", "nowhere.json"], "nowhere.json: no such file"),
        (["--out", "/proc/nothing"], "/proc/nothing"),
    ],
)
def test_wrong_options_are_one_line(trained, tmp_path, capsys, words, named):
    before = sorted(tmp_path.iterdir())
    out = [] if "--out" in words else ["--out", str(tmp_path / "o")]
    assert main(["render", trained, *out, *words]) == 2
    error = capsys.readouterr().err
    assert named in error and error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_no_run_is_one_line(tmp_path, capsys):
    assert main(["render", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert str(tmp_path) in error and error.count("\n") == 1


def test_a_folder_with_other_files_is_left_alone(trained, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("x")
    assert main(["render", trained, "--out", str(tmp_path), "--format", "png"]) == 2
    assert "holds files that are no frames" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
