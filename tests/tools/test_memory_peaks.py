import pytest
from support.scenes import write_ball_scene

from pp_cl.engine.device.device import Device
from tools import memory_peaks as TOOL
from tools.results import TABLES, columns

SETTINGS = {"points.count": 400, "network.widths": (16, 16, 16), "train.iterations": 4}


def test_a_row_is_what_a_training_took(session_device, tmp_path, monkeypatch):
    monkeypatch.setattr(TOOL, "open_device", lambda: Device(session_device.device))
    monkeypatch.setitem(TOOL.TRAININGS, "mini", ("tiny", SETTINGS))
    row = TOOL.peaks("mini", write_ball_scene(tmp_path / "ball"))
    assert row["name"] == "mini" and 300 < row["points"] < 500
    assert 0.9 < row["device_ratio"] < 1.1
    assert row["device_plan"] == pytest.approx(row["device_ratio"] * row["device"])
    assert row["host_plan"] == pytest.approx(row["host_ratio"] * row["host"])
    assert row["host"] > row["device"] > 0  # on a CPU, device memory is part of the host's
    assert all(column["cell"].format(**row) for column in columns(TABLES["memory"][1]))
