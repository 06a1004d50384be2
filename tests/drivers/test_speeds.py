"""The device that measured fastest is taken by default."""

import json
from types import SimpleNamespace

import pytest
from support.devices import fake

from pp_cl import drivers, speeds
from pp_cl.cli import main
from pp_cl.speeds import CLEARLY

POCL, INTEL = "Portable Computing Language", "Intel(R) OpenCL"


@pytest.fixture
def measured(monkeypatch, tmp_path):
    """A function that sets the speeds the next measurement of these devices finds, and returns a
    list that grows by a number with each measurement.
    """
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("PP_DEVICE", raising=False)
    counts, now = [], {}

    def measure():
        counts.append(len(counts) + 1)
        return now

    monkeypatch.setattr(speeds, "_measured", measure)

    def sets(rows, *values):
        now.clear()
        now.update(zip(map(speeds._key, [row[1] for row in rows]), values, strict=True))
        return counts

    return sets


def first(found):
    return speeds.by_speed(found)[0][0]


def test_the_fastest_is_taken_and_measured_once(measured):
    rows = [fake("A", "cpu"), fake("B", "gpu", gpu=True, index="1:0"), fake("C", "c", index="2:0")]
    counts = measured(rows, 5.0, 7.0, 6.0)
    assert first(rows) == "1:0"
    measured(rows, 9.0, 1.0, 1.0)  # another result, which must not be measured
    assert first(rows) == first(rows[::-1]) == "1:0" and counts == [1]
    assert first(rows[:1]) == "0:0" and first([rows[0], rows[2]]) == "2:0" and counts == [1]


def test_another_version_is_measured_anew(measured):
    rows = [fake("A", "a"), fake("B", "b", index="1:0")]
    counts = measured(rows, 5.0, 1.0)
    assert first(rows) == "0:0"
    newer = [rows[0], fake("B", "b", index="1:0", version="2")]
    measured(newer, 5.0, 6.0)
    assert first(newer) == "1:0" and counts == [1, 2]
    assert first(rows) == "0:0" and counts == [1, 2]  # in an environment with the older driver


def test_intels_driver_goes_before_another_of_cpus_that_is_not_clearly_faster(measured):
    rows = [fake(POCL, "cpu-Xeon"), fake(INTEL, "Xeon", index="1:0")]
    measured(rows, 99.0 * CLEARLY, 100.0)
    assert first(rows) == "1:0"
    newer = [rows[0], fake(INTEL, "Xeon", index="1:0", version="2")]
    measured(newer, 101.0 * CLEARLY, 100.0)
    assert first(newer) == "0:0"
    gpu = fake("A", "gpu", gpu=True, index="2:0")
    measured([*rows, gpu], 1.0, 100.0, 101.0)
    assert first([*rows, gpu]) == "2:0"


def test_what_does_not_work_or_cannot_be_measured_is_not_taken(measured):
    rows = [fake("A", "a"), fake("B", "b", index="1:0", problem="does not run: x")]
    counts = measured(rows, 1.0, 2.0)
    assert first(rows) == "0:0" and counts == []  # a single device works, so nothing is measured
    rows = [fake("A", "a", gpu=True), fake("B", "b", index="1:0")]
    measured(rows[1:], 2.0)  # the first device fails in the measurement
    assert first(rows) == "1:0" and first(rows) == "1:0" and counts == [1]


@pytest.mark.parametrize("content", ["", "[]", "1", '{"A, a, 1": "x"}', '{"A, a, 1": null}'])
def test_a_damaged_file_is_measured_anew(measured, tmp_path, content):
    rows = [fake("A", "a"), fake("B", "b", index="1:0")]
    counts = measured(rows, 1.0, 2.0)
    first(rows)
    (tmp_path / "cache" / speeds.SPEEDS).write_text(content)
    assert first(rows) == "1:0" and counts == [1, 2]


def test_without_a_cache_nothing_is_measured(measured, tmp_path, monkeypatch):
    """Otherwise each command would choose anew."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "file" / "cache"))
    rows = [fake(POCL, "a"), fake(INTEL, "b", index="1:0"), fake("B", "g", gpu=True, index="2:0")]
    counts = measured(rows, 3.0, 1.0, 2.0)
    assert [row[0] for row in speeds.by_speed(rows)] == ["2:0", "1:0", "0:0"] and counts == []


def test_commands_say_which_one_and_why(measured, monkeypatch, capsys):
    rows = [fake("A", "a"), fake("B", "b", index="1:0")]
    measured(rows, 1.0, 2.0)
    monkeypatch.setattr(drivers, "list_devices", lambda **_: rows)
    monkeypatch.setattr("pp_cl.engine.device.quirks.describe", lambda d: dict.fromkeys(NAMES, 1))
    assert main(["devices", "--json"]) == 0
    assert [row["default"] for row in json.loads(capsys.readouterr().out)] == [False, True]
    device = SimpleNamespace(name="b", info={"platform": "B"})
    assert drivers.device_line(device, None) == "device: b [B], the fastest of 2"
    assert drivers.device_line(device, "B") == "device: b [B]"
    monkeypatch.setenv("PP_DEVICE", "B")
    assert drivers.device_line(device, None) == "device: b [B]"


NAMES = ("name", "platform", "compute_units", "memory_bytes")
