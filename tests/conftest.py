"""Fixtures: the guarded device of all tests and commands, scenes and runs that tests share."""

import os
import shutil
import signal
from contextlib import suppress
from zlib import crc32

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from support.guarded import DATA, GuardedDevice, TracedDevice
from support.runs import SPECULAR_STEPS, Runs

from pp_cl import drivers
from pp_cl.drivers import open_device
from pp_cl.engine.device.device import Device
from pp_cl.engine.training import specular
from pp_cl.files.atomic import cache_folder, make_cache_folder
from pp_cl.metrics.lpips_weights import WEIGHTS_FILE
from pp_cl.scene import hull
from pp_studio.export import QUALITIES, QUICK, texture

# Profiles of Hypothesis: the same few examples each time, or the number that `make fuzz` sets
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


# A shell starts background programs with SIGINT ignored, and their children inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items):
    for item in items if not hasattr(os, "fork") else ():
        if item.get_closest_marker("unix"):
            item.add_marker(pytest.mark.skip(reason="needs Unix"))
    if part := os.environ.get("PP_SLOW_PART"):  # number/parts, such as 3/16
        number, parts = map(int, part.split("/"))
        for item in items:
            if item.get_closest_marker("slow") and crc32(item.nodeid.encode()) % parts == number:
                item.add_marker(pytest.mark.picked)


@pytest.fixture(scope="session", autouse=True)
def cache_of_its_own(tmp_path_factory):
    """Give the session a cache folder that holds only the weights of LPIPS, so that tests do not
    read the results about drivers in the user's cache. All processes share it, as they take the
    same device.
    """
    cached = cache_folder() / WEIGHTS_FILE
    folder = tmp_path_factory.getbasetemp()
    if os.environ.get("PYTEST_XDIST_WORKER"):  # a worker's base folder lies inside that of all
        folder = folder.parent
    lent = folder / "cache" / WEIGHTS_FILE
    lent.parent.mkdir(exist_ok=True)
    if cached.exists():
        with suppress(FileExistsError):
            lent.symlink_to(cached.resolve())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PP_CACHE", str(lent.parent))
        yield
    if lent.exists() and not lent.is_symlink() and not cached.exists():  # a test fetched it
        with suppress(FileNotFoundError):  # another process moved it first
            shutil.move(lent, make_cache_folder() / WEIGHTS_FILE)


@pytest.fixture(scope="session", autouse=True)
def small_work():
    """Use the few hull points (to compare masks) and texels that a ball needs, and few steps to fit
    Gaussians and specular layers; export/test_splat.py and training/test_specular.py test their
    quality.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hull, "COMPARED_POINTS", 8000)
        patch.setitem(QUALITIES, QUICK, (40, 0.0))
        patch.setattr(texture, "SIDE", 256)
        patch.setattr(specular, "STEPS", SPECULAR_STEPS)
        yield


@pytest.fixture(scope="session", autouse=True)
def session_device(tmp_path_factory):
    """The one device of a process: tests and the commands that they run share its built kernels.

    Its buffers are guarded, and traced if Oclgrind watches reads. If a test asks for another form,
    debug level or limit, a command opens a device of its own.
    """
    if os.environ.get("OCLGRIND_UNINITIALIZED") == "1":
        log = tmp_path_factory.mktemp("oclgrind") / "log"
        os.environ["OCLGRIND_LOG"] = str(log)
        device = TracedDevice(open_device().device, log)
    else:
        device = GuardedDevice(open_device().device)
    wanted = _variables()

    def shared(opened):
        return device if (opened, _variables()) == (device.device, wanted) else Device(opened)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drivers, "Device", shared)
        yield device


def _variables():
    """The environment variables that a Device reads."""
    return [os.environ.get(name) for name in ("PP_DEBUG", "PP_FORM", "PP_MAX_ALLOCATION")]


@pytest.fixture(autouse=True)
def no_stray_writes(session_device):
    """Check the canaries when a test ends, no matter what ran the kernels.

    Scratch memory is dropped: its values could hide that the next test forgets to write some.
    """
    yield
    session_device.check()
    session_device._scratch.clear()
    session_device.scratch_version += 1


@pytest.fixture
def dev(session_device):
    return session_device


@pytest.fixture
def plain(session_device):
    """The tests' device without guards, and without scratch memory of other tests."""
    return Device(session_device.device)


@pytest.fixture
def cpu_form(dev, monkeypatch):
    """Make the device take the form for CPUs, whatever PP_FORM says."""
    monkeypatch.delenv("PP_FORM", raising=False)
    monkeypatch.setattr(dev, "is_cpu", True)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def data():
    """The folder of real data (PP_DATA); skips the test if there is none."""
    if not DATA.is_dir():
        pytest.skip(f"no real data at {DATA}; set PP_DATA")
    return DATA


@pytest.fixture(scope="session")
def runs(tmp_path_factory, session_device):
    """Scenes and finished runs that all processes share."""
    folder = tmp_path_factory.getbasetemp()
    if os.environ.get("PYTEST_XDIST_WORKER"):  # a worker's base folder lies inside that of all
        folder = folder.parent
    (folder / "shared").mkdir(exist_ok=True)
    return Runs(folder / "shared")


@pytest.fixture(scope="session")
def scene(runs):
    """Folder of a small scene. Tests must not change it."""
    return runs.ball()


@pytest.fixture(scope="module")
def finished(runs, scene, tmp_path_factory):
    """Folder of an uninterrupted run; each module has its own copy."""
    return runs.trained(tmp_path_factory.mktemp("runs") / "whole", scene)
