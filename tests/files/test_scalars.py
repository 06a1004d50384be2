import json
import sys

import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.files.scalars import scalars


def test_a_row_gives_a_curve_for_every_number():
    row = {"step": 5, "seconds": 1.2, "device": "x", "psnr": 30.5, "finished": True}
    row |= {"points": 7, "rates": {"sh": (0.5, 0.1), "network": 1e-3}}
    curves = dict(scalars(row))
    assert curves.pop("finished") is True
    assert curves == {
        "psnr": 30.5,
        "points": 7,
        "rates/sh/0": 0.5,
        "rates/sh/1": 0.1,
        "rates/network": 1e-3,
    }


def test_without_the_package_one_line_names_the_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    monkeypatch.setattr("pp_cl.drivers.open_device", lambda _: pytest.fail("work"))
    assert main(["train", "demo", "--out", str(tmp_path / "run"), "--tensorboard"]) == 2
    assert "pip install tensorboardX" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_training_writes_the_numbers_of_its_log(tmp_path):
    pytest.importorskip("tensorboardX")
    scene, out = write_ball_scene(tmp_path / "ball"), tmp_path / "run"
    assert main([*arguments(scene, out, train__iterations=20), "--tensorboard"]) == 0
    curves = read_events(next((out / "tensorboard").iterdir()).read_bytes())
    log = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()[:-1]]
    for name in ("loss", "psnr", "ssim", "points"):
        assert curves[name] == [(row["step"], pytest.approx(row[name])) for row in log]
    assert curves["rates/sh/2"] == [
        (row["step"], pytest.approx(row["rates"]["sh"][2])) for row in log
    ]


def read_events(data):
    """{name: [(step, number)]} of an events file, whose records are length, checksum, bytes,
    checksum.
    """
    from tensorboardX.proto.event_pb2 import Event

    curves, place = {}, 0
    while place < len(data):
        length = int.from_bytes(data[place : place + 8], "little")
        event = Event.FromString(data[place + 12 : place + 12 + length])
        for value in event.summary.value:
            curves.setdefault(value.tag, []).append((event.step, value.simple_value))
        place += 12 + length + 4
    return curves
