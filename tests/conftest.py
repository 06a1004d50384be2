"""Fixtures: each device that works, guarded; the count of kernels launched and of tests that had
real data.
"""

import os
import shutil

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from support.guarded import DATA, GuardedDevice, TracedDevice
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.device.device import Device
from pp_cl.device.discover import list_devices, open_device
from pp_cl.device.launch import Program
from pp_cl.files.atomic import cache_folder, make_cache_folder
from pp_cl.metrics.lpips_weights import WEIGHTS_FILE

# of Hypothesis: the same few examples each time, or as many as `make fuzz` is told
settings.register_profile(
    "short",
    max_examples=60,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
settings.register_profile(
    "fuzz",
    settings.get_profile("short"),
    max_examples=int(os.environ.get("COUNT", "5000")),
    derandomize=False,
    print_blob=True,
)
settings.load_profile("short")

COUNTS = {"launches": 0, "data": 0}
_launch = Program.launch


def _counted_launch(self, *args, **kwargs):
    COUNTS["launches"] += 1
    return _launch(self, *args, **kwargs)


Program.launch = _counted_launch


@pytest.fixture(scope="session", autouse=True)
def cache_of_its_own(tmp_path_factory):
    """What the user has tuned stays unread: a cache folder for the session, with nothing in it but
    the weights of LPIPS.
    """
    kept = cache_folder() / WEIGHTS_FILE
    folder = tmp_path_factory.mktemp("cache")
    lent = folder / WEIGHTS_FILE
    if kept.exists():
        lent.symlink_to(kept.resolve())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PP_CACHE", str(folder))
        yield
    if lent.exists() and not lent.is_symlink() and not kept.exists():  # fetched by a test
        shutil.move(lent, make_cache_folder() / WEIGHTS_FILE)


def devices():
    """PP_DEVICE, else the indices of all devices that work; None, the default one, if that is all
    there is.
    """
    if os.environ.get("PP_DEVICE"):
        return [os.environ["PP_DEVICE"]]
    found = [index for index, _, problem in list_devices() if problem is None]
    return found if len(found) > 1 else [None]


DEVICES = devices()


@pytest.fixture(
    scope="session",
    params=DEVICES,
    ids=[f"device {name}" if name else "device" for name in DEVICES],
)
def session_device(request, tmp_path_factory):
    """A device with guarded buffers; with traced ones where Oclgrind watches reads."""
    if os.environ.get("OCLGRIND_UNINITIALIZED") != "1":
        return GuardedDevice(open_device(request.param).device)
    log = tmp_path_factory.mktemp("oclgrind") / "log"
    os.environ["OCLGRIND_LOG"] = str(log)
    return TracedDevice(open_device(request.param).device, log)


@pytest.fixture
def dev(session_device):
    """The guarded device; the canaries are checked when the test ends."""
    yield session_device
    session_device.finish()
    session_device.check()


@pytest.fixture
def plain(session_device):
    """The tests' device without guards, and without the scratch of other tests."""
    return Device(session_device.device)


@pytest.fixture
def cpu_form(dev, monkeypatch):
    """For a test of what is chosen on CPUs: the device takes their form, PP_FORM or not."""
    monkeypatch.delenv("PP_FORM", raising=False)
    monkeypatch.setattr(dev, "is_cpu", True)


@pytest.fixture
def rng():
    """A seeded numpy generator."""
    return np.random.default_rng(7)


@pytest.fixture
def data():
    """The folder of real data (PP_DATA); skips where there is none."""
    if not DATA.is_dir():
        pytest.skip(f"no real data at {DATA}; set PP_DATA")
    COUNTS["data"] += 1
    return DATA


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Folder of a small scene."""
    return write_ball_scene(tmp_path_factory.mktemp("scene") / "ball")


@pytest.fixture(scope="module")
def finished(scene, tmp_path_factory):
    """Folder of an uninterrupted run."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    assert main(arguments(scene, out)) == 0
    return out


def pytest_terminal_summary(terminalreporter):
    """Say what really ran."""
    terminalreporter.write_line(
        f"kernel launches: {COUNTS['launches']}; tests on real data: {COUNTS['data']}"
    )


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    """Take over what a worker of pytest-xdist has counted."""
    for name, count in getattr(node, "workeroutput", {}).get("counts", {}).items():
        COUNTS[name] += count


def pytest_sessionfinish(session, exitstatus):
    """A whole run that launched no kernel has tested nothing."""
    if hasattr(session.config, "workeroutput"):  # a worker, whose counts go to the first process
        session.config.workeroutput["counts"] = COUNTS
    elif session.testscollected > 100 and COUNTS["launches"] == 0:
        session.exitstatus = 1
