"""tools/memory_peaks.py: its trainings make sense, and its rows are what plan and devices say."""

import json

import pytest
from support.scenes import write_ball_scene

from pp_cl.config import assign, preset, validate
from pp_cl.engine.device.device import Device
from pp_cl.scene.load import load_scene
from tools import memory_peaks as TOOL
from tools.results import MEMORY

SETTINGS = {"points.count": 400, "network.widths": (16, 16, 16), "train.iterations": 4}


@pytest.mark.parametrize("name", TOOL.TRAININGS)
def test_the_settings_of_each_training_are_allowed(name):
    preset_name, settings = TOOL.TRAININGS[name]
    config = preset(preset_name)
    for key, value in (TOOL.EARLY | settings).items():
        assign(config, key, value, name)
    validate(config, name)


def test_a_row_is_what_a_training_took(session_device, tmp_path, monkeypatch):
    monkeypatch.setattr(TOOL, "open_device", lambda: Device(session_device.device))
    monkeypatch.setitem(TOOL.TRAININGS, "mini", ("tiny", SETTINGS))
    row = TOOL.peaks("mini", write_ball_scene(tmp_path / "ball"))
    assert row["name"] == "mini" and 300 < row["points"] < 500
    assert 0.9 < row["device_ratio"] < 1.1
    assert row["device_plan"] == pytest.approx(row["device_ratio"] * row["device"])
    assert row["host_plan"] == pytest.approx(row["host_ratio"] * row["host"])
    assert row["host"] > row["device"] > 0  # a CPU's memory is the host's
    assert all(column["cell"].format(**row) for column in MEMORY)


def test_the_images_of_a_phone_show_a_ball(tmp_path, monkeypatch):
    monkeypatch.setattr(TOOL, "PHONE", (80, 60))
    scene = load_scene(TOOL.write_phone_scene(tmp_path, count=6))
    views = scene.splits["train"]
    assert len(views) == 6 and all(view.image.shape == (60, 80, 4) for view in views)
    covered = (views[0].image[..., 3] > 127).mean()
    assert covered == pytest.approx(3.1416 * (0.4 * 60) ** 2 / (80 * 60), rel=0.1)
    assert json.loads((tmp_path / "transforms_train.json").read_text())["frames"][5]
