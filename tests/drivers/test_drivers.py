import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pyopencl as cl
import pytest

from pp_cl import drivers

POCL = Path("/etc/OpenCL/vendors/pocl.icd")
COMPILER = shutil.which("cc")
pytestmark = [
    pytest.mark.skipif(sys.platform != "linux" or not COMPILER, reason="needs a C compiler, Linux"),
    pytest.mark.skipif(not POCL.exists(), reason="needs PoCL"),
]


def compiled(library, *flags):
    source = Path(__file__).with_name("icd.c")
    subprocess.run([COMPILER, "-shared", "-fPIC", *flags, "-o", library, source], check=True)
    return library


@pytest.fixture
def vendors(tmp_path, monkeypatch):
    """Replaces this machine's drivers by PoCL alone, with an empty cache; returns a function that
    compiles and adds a driver, by name and flags.
    """
    folder = tmp_path / "vendors"
    folder.mkdir()
    shutil.copy(POCL, folder / "pocl.icd")
    monkeypatch.setenv("OCL_ICD_VENDORS", str(folder))
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("PP_DEVICE", raising=False)

    def add(name, *flags):
        library = compiled(tmp_path / f"lib{name}.so", *flags)
        (folder / f"{name}.icd").write_text(f"{library}\n")

    return add


def python(code):
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout + ran.stderr


def listed(code="import sys; from pp_cl.cli import main; sys.exit(main(['devices', '--json']))"):
    """{name of a device or driver: its row}, as `pp-cl devices` prints them in a fresh process."""
    return {os.path.basename(row["name"]): row for row in json.loads(python(code))}


def test_drivers_that_crash_and_one_that_builds_nothing(vendors, tmp_path):
    vendors("crash", "-DCRASHES")
    vendors("late", "-DCRASHES_IN_BUILD")
    vendors("broken")
    rows = listed()
    assert "SIGABRT" in rows["crash.icd"]["problem"] and "SIGABRT" in rows["late.icd"]["problem"]
    assert rows["unbuilding"]["problem"].startswith("does not run")
    assert [row["index"] for row in rows.values() if row["problem"] is None]
    # later processes try no driver and load no harmful one, until a new driver is added
    opened = "from pp_cl import drivers; {} print(drivers.open_device().name)"
    assert python(opened.format("drivers._probe = None;")).strip() in rows
    vendors("other", "-DCRASHES")
    assert python(opened.format("")).strip() in rows
    # the results about the drivers before are still kept
    kept = sorted(file.read_text().count("other.icd") for file in (tmp_path / "cache").iterdir())
    assert kept == [0, 1]


@pytest.mark.slow  # a driver counts as hanging after 20 s
def test_a_driver_that_hangs(vendors):
    vendors("crash", "-DCRASHES")
    vendors("hang", "-DHANGS")
    vendors("broken")
    start = time.monotonic()
    rows = listed()
    assert time.monotonic() - start < 60  # 20 s for the driver that hangs, then all others again
    assert {"crash.icd", "hang.icd", "unbuilding"} < set(rows)
    assert "20 seconds" in rows["hang.icd"]["problem"]
    commands = [process.info["cmdline"] or [] for process in psutil.process_iter(["cmdline"])]
    library = str(Path(os.environ["OCL_ICD_VENDORS"]).with_name("libhang.so"))
    assert not [words for words in commands if library in " ".join(words)]
    assert [row["index"] for row in rows.values() if row["problem"] is None]


def test_intels_runtime_is_found_beside_pp_cl(tmp_path, monkeypatch):
    """A driver of the tests lies where pip installs Intel's; OCL_ICD_VENDORS ends the search."""
    compiled(tmp_path / "libintelocl.so")
    about = tmp_path / "intel_opencl_rt-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Name: intel-opencl-rt\nVersion: 1\n")
    (about / "RECORD").write_text("libintelocl.so,,\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("OCL_ICD_VENDORS", raising=False)
    assert listed()["unbuilding"]["problem"].startswith("does not run")
    monkeypatch.setenv("OCL_ICD_VENDORS", str(POCL))
    assert "unbuilding" not in listed()


def test_what_was_found_is_kept_and_found_anew_where_its_file_is_damaged(
    session_device, tmp_path, monkeypatch
):
    shown, probed = drivers.try_drivers(again=True), []
    monkeypatch.setattr(drivers, "_probe", lambda _: probed.append(0) or shown)

    def tried(cache):
        monkeypatch.setenv("PP_CACHE", str(cache))
        drivers._tried.clear()
        result, count = drivers.try_drivers(), len(probed)
        rows = {tuple(row[:3]): row[3] for row in result["devices"]}
        assert rows[drivers.identity(session_device.device)] is None
        return count

    assert tried(tmp_path) == tried(tmp_path) == 1
    (file,) = tmp_path.iterdir()
    stored = json.loads(file.read_text())
    broken = stored | {"devices": [[*row[:3], "broken"] for row in stored["devices"]]}
    damaged = [stored | {"devices": 1}, stored | {"devices": [[]]}, stored | {"left_out": []}]
    for n, content in enumerate([[], {}, *damaged, broken], 2):
        file.write_text(json.dumps(content))
        assert tried(tmp_path) == n
    file.write_text("{")
    assert tried(tmp_path) == tried(tmp_path) == 8
    file.write_text("")
    assert tried(file / "cache") == 9


def test_a_process_that_dies_before_any_driver_is_not_started_for_ever(monkeypatch):
    commands = []

    def dies(command, **_):
        commands.append(command)
        return subprocess.CompletedProcess(command, 1, stdout="", stderr="no memory")

    monkeypatch.setattr(drivers.subprocess, "run", dies)
    found = drivers._probe({"a.icd": "a.so", "b.icd": "b.so"})
    assert found["devices"] == [] and [*found["left_out"]] == ["a.icd", "b.icd"]
    assert len(commands) == 2


@pytest.mark.parametrize("result", ["wrong", "error"])
def test_probe_names_the_problem(session_device, monkeypatch, result):
    change = {"wrong": ("2.0f", "3.0f"), "error": ("2.0f", "undeclared")}
    monkeypatch.setattr(drivers, "PROBE", drivers.PROBE.replace(*change[result]))
    problem = drivers.find_problem(session_device.device)
    assert {"wrong": "computes a wrong result", "error": "does not run: "}[result] in problem
    assert "\n" not in problem


def test_without_a_driver_nothing_is_listed(monkeypatch):
    def none():
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", none)
    assert drivers.load_drivers({drivers.REST: ""}) == []


def test_a_lock_of_a_killed_process_keeps_nobody_waiting(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    old, held = (tmp_path / "pyopencl" / name / "lock" for name in ("old", "held"))
    for lock in (old, held):
        lock.parent.mkdir(parents=True)
        lock.touch()
    past = time.time() - 2 * drivers.STALE
    os.utime(old, (past, past))
    drivers.list_devices()
    assert held.exists() and not old.exists()
