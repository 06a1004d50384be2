import json

import pytest
from support.runs import SETTINGS, set_words
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.files.run_folder import RunFolder
from pp_cl.session import decide
from pp_cl.session.decide import config_of, free_share


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A scene of 400 pixels on a quiet machine like the one of decide.SIDES."""
    monkeypatch.setattr(decide, "free_share", lambda: 1.0)
    monkeypatch.setattr(decide, "speed_of", lambda device: decide.PACE)
    monkeypatch.setattr(decide, "SIDES", {0.0: ("tiny", 160), 5.0: ("small", 320)})
    return write_ball_scene(tmp_path / "ball", views=4, size=400)


def chosen(scene, tmp_path, preset=None, **settings):
    given = [(key.replace("__", "."), value, "test") for key, value in settings.items()]
    return config_of(RunFolder(tmp_path / "run"), scene, preset, given, None)


def test_minutes_decide_the_size_of_the_images(scene, tmp_path):
    config = chosen(scene, tmp_path)
    assert (config.preset, config.scene.downscale, config.train.minutes) == ("small", 1.25, 10)
    told = "size: images reduced 1.25 times, for 10 minutes on this device (--downscale"
    assert config.decisions["scene.downscale"].startswith(told)
    config = chosen(scene, tmp_path, train__minutes="4")
    assert (config.preset, config.scene.downscale, config.train.minutes) == ("tiny", 2.5, 4)


def test_who_names_a_preset_or_iterations_gets_these(scene, tmp_path):
    config = chosen(scene, tmp_path, train__iterations="100")
    assert (config.preset, config.scene.downscale, config.train.minutes) == ("tiny", 2, 0)
    assert chosen(scene, tmp_path, "small", train__minutes="4").scene.downscale == 1
    assert chosen(scene, tmp_path, train__minutes="4", scene__downscale="1").scene.downscale == 1


@pytest.mark.parametrize("share, speed", [(0.4, 1), (1, 0.4)], ids=["busy", "slow"])
def test_other_programs_and_slow_devices_make_images_smaller(
    scene, tmp_path, monkeypatch, share, speed
):
    monkeypatch.setattr(decide, "free_share", lambda: share)
    monkeypatch.setattr(decide, "speed_of", lambda device: speed * decide.PACE)
    config = chosen(scene, tmp_path, train__minutes="10")
    assert config.preset == "tiny"
    told = config.decisions["scene.downscale"]
    assert ("of which other programs take 60%" in told) == (share < 1)


@pytest.mark.parametrize(
    "busy, load, share",
    [(0, 4, 1), (50, 4, 2 / 3), (100, 4, 1 / 3), (100, 0, 1 / 2)],
    ids=["ended", "one of two cores", "four programs", "no mean yet"],
)
def test_programs_that_run_take_their_share(monkeypatch, busy, load, share):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    monkeypatch.setattr("psutil.cpu_percent", lambda interval: busy)
    monkeypatch.setattr("psutil.getloadavg", lambda: (load, load, load))
    assert free_share() == pytest.approx(share)


def test_a_training_on_resampled_images_tells_its_decisions(scene, tmp_path, capsys):
    """Images of 400 pixels are resampled to 320, which no whole number gives."""
    short = {key: value for key, value in SETTINGS.items() if key != "train.iterations"}
    words = ["train", scene, "--out", str(tmp_path / "run"), "--minutes", "0.05"]
    words += set_words(short, points__count=500, train__specular="off")
    assert main([*words, "--downscale", "1.25"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "images: scaled from 400x400 to 320x320" in lines
    config = json.loads((tmp_path / "run/config.json").read_text())
    for why in config["decisions"].values():
        assert why in lines
    assert main(["info", str(tmp_path / "run")]) == 0
    told = capsys.readouterr().out
    assert "images reduced 1.25 times" in told
    assert all(why in told for why in config["decisions"].values())
    assert main(["eval", str(tmp_path / "run")]) == 0
