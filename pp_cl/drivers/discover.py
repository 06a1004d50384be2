"""OpenCL devices: listing those that work, choosing one."""

import atexit
import os
import platform
import shutil
import sys
import tempfile
import warnings

import pyopencl as cl

from pp_cl.drivers.drivers import (
    RUNTIME,
    devices_of,
    identity,
    in_conda,
    load,
    runtime_library,
    try_drivers,
)
from pp_cl.engine.device.device import Device
from pp_cl.errors import UserError

TEMPORARY_CACHE = "pp-cl-cache-"
UNSEEN = "was not seen when its driver was tried"


def mend() -> str:
    """What to do where nothing works: the one command that brings this system a device."""
    managers = {
        "apt-get": "sudo apt install pocl-opencl-icd",
        "dnf": "sudo dnf install pocl",
        "pacman": "sudo pacman -S pocl",
    }
    found = [command for name, command in managers.items() if shutil.which(name)]
    intel = platform.machine() in ("x86_64", "AMD64") and sys.platform != "darwin"
    if intel and not in_conda() and not runtime_library():
        command = f"pip install {RUNTIME} intel-cmplr-lib-rt"
    elif found and sys.platform == "linux" and not in_conda():
        command = found[0]
    else:
        command = "conda install -c conda-forge pyopencl pocl"
    return f"install a driver with `{command}`; docs/install.md names those of GPUs"


def list_devices(*, again: bool = False) -> list[tuple[str, cl.Device, str | None]]:
    """[(index "platform:device", cl.Device, problem or None)] of all OpenCL devices whose drivers
    neither crash nor hang. again: drivers are tried anew, not only those that are not known yet.
    """
    _give_cache()
    tried = try_drivers(again=again)
    known: dict[tuple[str, ...], list[str | None]] = {}  # of devices that are alike in their order
    for *name, problem in (row for rows in tried.values() if type(rows) is list for row in rows):
        known.setdefault(tuple(name), []).append(problem)
    found: list[tuple[str, cl.Device, str | None]] = []
    for p, owner in enumerate(load(tried)):
        for d, device in enumerate(devices_of(owner)):
            problems = known.get(identity(device))
            if not problems and not again:  # another version, or a device more
                return list_devices(again=True)
            found.append((f"{p}:{d}", device, problems.pop(0) if problems else UNSEEN))
    return found


def list_left_out() -> list[tuple[str, str]]:
    """[(driver, problem)] of the drivers that crash or hang."""
    return [(name, rows) for name, rows in try_drivers().items() if type(rows) is str]


def separate_devices() -> list[str]:
    """Indices "platform:device" of the devices that can work side by side: PP_DEVICE alone if it is
    set, else the GPUs that work, else one other device. What two platforms list under one name is
    taken for one. Raises UserError where nothing works.
    """
    if os.environ.get("PP_DEVICE"):
        return [os.environ["PP_DEVICE"]]
    working = [(i, device) for i, device, problem in list_devices() if problem is None]
    gpus: dict[str, dict[str, list[str]]] = {}  # name: {platform: indices}
    for index, device in working:
        if device.type & cl.device_type.GPU:
            platforms = gpus.setdefault(device.name.strip(), {})
            platforms.setdefault(device.platform.name, []).append(index)
    if gpus:
        return [index for platforms in gpus.values() for index in next(iter(platforms.values()))]
    if not working:
        open_device()  # says what is wrong
    return [working[0][0]]


def _give_cache():
    """Drivers and pyopencl fail where the user's cache cannot be written (containers, service
    accounts): a temporary one.
    """
    # pyopencl 2026.1 reads this variable, unset or not, where its cache cannot be written: KeyError
    os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")
    if sys.platform == "win32":
        return  # which has caches elsewhere
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(2**20))  # a full disk is noticed as well
    except OSError as error:
        temporary = os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix=TEMPORARY_CACHE)
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        warnings.warn(
            f"{folder}: {error.strerror}; kernels are built again: set XDG_CACHE_HOME to keep them",
            stacklevel=3,
        )


def open_device(choice: str | None = None) -> Device:
    """Device chosen by `choice`, else PP_DEVICE, else the first GPU that works, else the first
    other device that works.

    choice: "platform:device" as printed by `pp-cl devices`, or a part of the platform's or device's
    name; a platform's comes first, as PoCL's devices carry the name of the processor ("intel" means
    Intel's driver wherever there is one), then the whole of a device's. Raises UserError when
    nothing matches or nothing works; never takes another device than the one asked for.
    """
    choice = choice or os.environ.get("PP_DEVICE")
    found = list_devices()
    wanted = sorted((f for f in found if _rank(f, choice)[0] < 4), key=lambda f: _rank(f, choice))
    for _, device, problem in wanted:
        if problem is None:
            return Device(device)
    listed = "; ".join(
        [
            f"{i} {d.name.strip()} ({d.platform.name.strip()}) {problem or 'works'}"
            for i, d, problem in found
        ]
        + [f"{driver} {problem}" for driver, problem in list_left_out()]
    )
    if choice and not wanted and found:
        raise UserError(f"device {choice!r}: no such OpenCL device; found {listed}")
    asked = f"device {choice!r}: " if choice else ""
    raise UserError(f"{asked}no working OpenCL device (found {listed or 'none'}): {mend()}")


def _rank(found, choice):
    """Sort key of one list_devices() entry: (0-3 how it matches `choice`, 4 not at all; GPUs
    first).
    """
    index, device, _ = found
    if not choice or choice == index:
        match = 0
    elif choice.lower() in device.platform.name.lower():
        match = 1
    elif choice.lower() == device.name.strip().lower():
        match = 2
    else:
        match = 3 if choice.lower() in device.name.lower() else 4
    return match, not device.type & cl.device_type.GPU
