"""Finds the OpenCL drivers and devices of this machine that work, and chooses a device.

A separate process tries all drivers: a driver that crashes or hangs ends only that process, and is
reported and left out.
"""

import atexit
import ctypes
import faulthandler
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from platformdirs import user_cache_dir

from pp_cl.engine.device.device import Device
from pp_cl.engine.device.kernel import quiet_compiler
from pp_cl.errors import UserError
from pp_cl.files.atomic import cache_folder, make_cache_folder, write_json
from pp_cl.speeds import Listed, by_speed, identity, is_gpu

RUNTIME = "intel-opencl-rt"  # Intel's CPU runtime, which the extra `cpu` installs
RUNTIME_LIBRARIES = ("libintelocl.so", "intelocl64.dll")
CHOSEN = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH")  # variables with which users name drivers
REST = "the system's OpenCL drivers"  # if they cannot be told apart before they are loaded
SECONDS = 20  # for a driver: a first build takes 1 to 2, several times as long on a busy machine
STALE = 20  # seconds; pyopencl keeps its cache locked for milliseconds
BEGINS = "pp-cl begins with "  # the line that report() prints before it tries a driver
TEMPORARY_CACHE = "pp-cl-cache-"
UNSEEN = "was not seen when its driver was tried"
NONE = 4  # _match() of a device that does not match

LEAST_CONSTANT = 64  # bytes of constant memory for the kernels' tables

# A device is accepted only if it runs this kernel: PyPI's PoCL 3.0 is listed on current CPUs but
# fails every build.
PROBE = "kernel void probe(global float *x) { x[get_global_id(0)] *= 2.0f; }"

# {"devices": [[platform, name, version, problem or None]], "left_out": {driver: why}}
Found = dict[str, Any]
_tried: dict[str, Found] = {}  # {_kept_in() of the drivers: this process's result of trying them}


# ---- devices


def open_device(choice: str | None = None) -> Device:
    """The device chosen by `choice`, or else by PP_DEVICE, or else the fastest one that works.

    choice: "platform:device" as printed by `pp-cl devices`, a part of the platform's name, or the
    whole or a part of the device's name, in this order, since PoCL's devices have the processor's
    name; the fastest match is taken. Raises UserError if no device matches or works.
    """
    choice = choice or os.environ.get("PP_DEVICE")
    devices = list_devices()
    matches = [_match(row, choice) for row in devices]
    working = [m for m, row in zip(matches, devices, strict=True) if row[2] is None and m < NONE]
    if working:
        best = min(working)
        alike = [row for m, row in zip(matches, devices, strict=True) if m == best]
        return Device(by_speed(alike)[0][1])
    lines = [
        f"{i} {device.name.strip()} ({device.platform.name.strip()}) {problem or 'works'}"
        for i, device, problem in devices
    ]
    lines += [f"{driver} {problem}" for driver, problem in list_left_out()]
    listed = "; ".join(lines)
    if choice and devices and min(matches) == NONE:
        raise UserError(f"device {choice!r}: no such OpenCL device; found {listed}")
    asked = f"device {choice!r}: " if choice else ""
    raise UserError(f"{asked}no working OpenCL device (found {listed or 'none'}): {mend()}")


def device_line(device: Device, choice: str | None) -> str:
    """The line in which a command names its device and the reason for it. choice: as in
    open_device().
    """
    chosen = choice or os.environ.get("PP_DEVICE")
    others = 0 if chosen else len(by_speed(list_devices())) - 1
    why = f", the fastest of {others + 1}" if others > 0 else ""
    return f"device: {device.name} [{device.info['platform']}]{why}"


def _match(row, choice):
    """How well an entry of list_devices() matches `choice`: 0 is best, NONE is no match."""
    index, device, _ = row
    word, name = (choice or index).lower(), device.name.strip().lower()
    ways = word == index, word in device.platform.name.lower(), word == name, word in name
    return next((n for n, matches in enumerate(ways) if matches), NONE)


def list_devices(*, again: bool = False) -> list[Listed]:
    """[(index "platform:device", cl.Device, problem or None)] of the devices whose drivers neither
    crash nor hang. again: try all drivers anew.
    """
    _give_cache()
    tried = try_drivers(again=again)
    known: dict[tuple[str, ...], list[str | None]] = {}  # of equal devices, in their order
    for *name, problem in tried["devices"]:
        known.setdefault(tuple(name), []).append(problem)
    usable = {n: lib for n, lib in find_drivers().items() if n not in tried["left_out"]}
    rows: list[Listed] = []
    for p, owner in enumerate(load_drivers(usable)):
        for d, device in enumerate(devices_of(owner)):
            problems = known.get(identity(device))
            if not problems and not again:  # another version, or an additional device
                return list_devices(again=True)
            rows.append((f"{p}:{d}", device, problems.pop(0) if problems else UNSEEN))
    return rows


def list_left_out() -> list[tuple[str, str]]:
    """[(driver, problem)] for the drivers that crash or hang."""
    return [*try_drivers()["left_out"].items()]


def separate_devices() -> list[str]:
    """Indices "platform:device" of the devices that can work side by side: PP_DEVICE alone if it is
    set; otherwise the device that open_device() takes and, if that is a GPU, the other GPUs that
    work. Of GPUs with the same name, those of one platform are taken. Raises UserError if no device
    works.
    """
    if os.environ.get("PP_DEVICE"):
        return [os.environ["PP_DEVICE"]]
    working = by_speed(list_devices())
    if not working:
        open_device()  # says what is wrong
    if not is_gpu(working[0][1]):
        return [working[0][0]]
    owners: dict[str, str] = {}  # {name of a GPU: the platform from which it is taken}
    return [
        index
        for index, device, _ in working
        if is_gpu(device)
        and owners.setdefault(device.name.strip(), device.platform.name) == device.platform.name
    ]


def mend() -> str:
    """Advice if no device works: the one command that installs a driver on this system."""
    managers = {
        "apt-get": "sudo apt install pocl-opencl-icd",
        "dnf": "sudo dnf install pocl",
        "pacman": "sudo pacman -S pocl",
    }
    commands = [command for name, command in managers.items() if shutil.which(name)]
    intel = platform.machine() in ("x86_64", "AMD64") and sys.platform != "darwin"
    if intel and not in_conda() and not runtime_library():
        command = f"pip install {RUNTIME} intel-cmplr-lib-rt"
    elif commands and sys.platform == "linux" and not in_conda():
        command = commands[0]
    else:
        command = "conda install -c conda-forge pyopencl pocl"
    return f"install a driver with `{command}`; docs/install.md names those of GPUs"


def devices_of(platform: cl.Platform) -> list[cl.Device]:
    """The devices of a platform."""
    try:
        return platform.get_devices()
    except cl.Error:
        return []  # a platform without devices raises an error


def find_problem(device: cl.Device) -> str | None:
    """What keeps a device from working; None if it runs a test kernel."""
    if device.max_constant_buffer_size < LEAST_CONSTANT:
        return (
            f"holds {device.max_constant_buffer_size} bytes of constants, but needs"
            f" {LEAST_CONSTANT}"
        )
    try:
        context = cl.Context([device])
        queue = cl.CommandQueue(context)
        with quiet_compiler():
            program = cl.Program(context, PROBE).build()
        x = cl_array.to_device(queue, np.arange(4, dtype=np.float32))
        program.probe(queue, (4,), None, x.data)
        return None if np.array_equal(x.get(), [0, 2, 4, 6]) else "computes a wrong result"
    except cl.Error as error:
        return "does not run: " + " ".join(str(error).split())[:160]


def _give_cache():
    """Set up a temporary cache if the user's cannot be written, which makes drivers and pyopencl
    fail; remove the locks of killed processes, for which pyopencl waits a minute at each build.
    """
    # if its cache cannot be written, pyopencl 2026.1 raises KeyError while this variable is unset
    os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")
    for lock in Path(user_cache_dir("pyopencl", "pyopencl")).glob("*/lock"):
        with suppress(OSError):  # another process may have removed it
            if time.time() - lock.stat().st_mtime > STALE:
                lock.unlink()
    if sys.platform == "win32":
        return  # Windows has its caches elsewhere
    home = os.path.expanduser("~/.cache")
    for name, usual in (("XDG_CACHE_HOME", home), ("POCL_CACHE_DIR", "")):
        folder = os.environ.get(name) or usual
        if not folder or not (fault := _fault_of(folder)):
            continue
        # other file systems may have the same fault
        places = (tempfile.gettempdir(), "/var/tmp", os.getcwd())  # noqa: S108 - of a new folder
        place = next((place for place in places if not _fault_of(place)), None)
        temporary = os.environ[name] = tempfile.mkdtemp(prefix=TEMPORARY_CACHE, dir=place)
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        what = f"{folder}: {fault}; kernels are built again in {temporary}"
        warnings.warn(f"{what}: set {name} to keep them", stacklevel=3)


def _fault_of(folder):
    """What keeps drivers from using a folder as cache, which is created; "" if nothing does."""
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(2**20))  # a full disk is noticed as well
    except OSError as error:
        return error.strerror
    # PoCL stores kernels as libraries, and ends the process if it may not load them
    is_noexec = os.statvfs(folder).f_flag & getattr(os, "ST_NOEXEC", 0)
    return "is mounted noexec, so that no kernel in it can run" if is_noexec else ""


# ---- drivers: found, tried, loaded


def find_drivers() -> dict[str, str]:
    """{name: library}: each .icd file and its library on Linux, or one name with "" for all drivers
    that the system's loader finds; and Intel's runtime from this environment, with its library as
    name.
    """
    chosen = next((os.environ[name] for name in CHOSEN if os.environ.get(name)), "")
    drivers: dict[str, str] = {}
    if sys.platform == "linux" and (not chosen or os.path.isdir(chosen)):
        conda = Path(sys.prefix, "etc/OpenCL/vendors") if in_conda() else None
        places = [Path(chosen)] if chosen else [conda, Path("/etc/OpenCL/vendors")]
        places.append(Path(cl.__file__).parent / ".libs")
        for icd in (icd for place in places if place for icd in sorted(place.glob("*.icd"))):
            with suppress(OSError, ValueError):
                drivers[str(icd)] = icd.read_text("utf-8").strip()
    runtime = None if chosen else runtime_library()
    if not drivers and not (runtime and sys.platform == "linux"):
        drivers = {chosen or REST: ""}
    if runtime and str(runtime) not in map(os.path.realpath, drivers.values()):
        drivers[str(runtime)] = str(runtime)
    return drivers


def runtime_library() -> Path | None:
    """The library of Intel's CPU runtime in this Python environment, or None; the .icd file of the
    runtime names another place.
    """
    with suppress(PackageNotFoundError):
        for file in files(RUNTIME) or []:
            if file.name in RUNTIME_LIBRARIES and (path := Path(str(file.locate()))).is_file():
                return path.resolve()
    return None


def in_conda() -> bool:
    """Whether this Python belongs to a conda environment, whose loader has its own drivers."""
    return Path(sys.prefix, "conda-meta").is_dir()


def try_drivers(*, again: bool = False) -> Found:
    """The result of trying the drivers, from the user's cache; they are tried anew if the cache
    lacks it, if no device worked, or if `again`.
    """
    drivers = find_drivers()
    file = _kept_in(drivers)
    result = {} if again else _tried.get(file) or _read(cache_folder() / file)
    if not result:
        result = _probe(drivers)
        with suppress(UserError):  # without a cache, drivers are tried at each start
            write_json(make_cache_folder() / file, result)
    _tried[file] = result
    return result


def _kept_in(drivers):
    """The name of the cache's file for these drivers; other versions have another name."""
    about = [cl.VERSION_TEXT]
    for names in drivers.items():
        file = next(filter(os.path.isfile, reversed(names)), None)
        about.append([*names, file and os.stat(file).st_mtime_ns])
    return f"drivers-{hashlib.sha256(json.dumps(about).encode()).hexdigest()[:16]}.json"


def _read(path):
    """The stored result of trying drivers; {} if no device worked, or the file is missing or
    damaged.
    """
    try:
        result = json.loads(path.read_text("utf-8"))
        works = any(problem is None for _, _, _, problem in result["devices"])
        return result if works and isinstance(result["left_out"], dict) else {}
    except (OSError, ValueError, TypeError, LookupError):
        return {}


def _probe(drivers):
    """The result of report() in a separate process, restarted without each driver that crashes or
    hangs.
    """
    code = f"import sys; sys.path[:] = {sys.path!r}; from pp_cl import drivers; drivers.report()"
    left_out: dict[str, str] = {}
    while True:
        tried = {name: library for name, library in drivers.items() if name not in left_out}
        command = [sys.executable, "-c", code, json.dumps(tried)]
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace"
        )
        lines = done.stdout.splitlines()
        if done.returncode == 0:  # drivers may have printed other lines before
            return {"devices": json.loads(lines[-1]), "left_out": left_out}
        if not tried:  # it is no driver that ends the process
            return {"devices": [], "left_out": left_out}
        begun = [line.removeprefix(BEGINS) for line in lines if line.startswith(BEGINS)]
        status = done.returncode
        how = signal.Signals(-status).name if status < 0 else f"status {status:#x}"
        is_late = "Timeout (" in done.stderr  # as faulthandler says
        why = f"does not answer within {SECONDS} seconds" if is_late else f"crashes ({how})"
        left_out |= {json.loads(begun[-1]): why} if begun else dict.fromkeys(tried, why)


def report() -> None:
    """Try the drivers in sys.argv[1], JSON of {name: library}; print each driver's name before it
    is tried, and at last the rows of all devices as JSON. A driver that takes SECONDS ends the
    process.
    """

    def begin(name: str) -> None:
        print(f"\n{BEGINS}{json.dumps(name)}", flush=True)  # noqa: T201 - read by _probe()
        faulthandler.dump_traceback_later(SECONDS, exit=True)

    drivers: dict[str, str] = json.loads(sys.argv[1])
    owners: dict[int, str] = {}  # {address of a platform: its driver}
    for name, library in drivers.items():
        begin(name)
        owners |= dict.fromkeys(_addresses(library) if library else (), name)
    unnamed = next((name for name, library in drivers.items() if not library), "")
    rows: list[list[str | None]] = []
    for owner in load_drivers(drivers):
        begin(owners.get(owner.int_ptr, unnamed))
        rows += [[*identity(device), find_problem(device)] for device in devices_of(owner)]
    print(f"\n{json.dumps(rows)}", flush=True)  # noqa: T201 - read by _probe()
    os._exit(0)  # some drivers crash when a process ends


def load_drivers(drivers: dict[str, str]) -> list[cl.Platform]:
    """The platforms of these drivers; the system's loader sees no others when it is first used."""
    libraries = [library for name, library in drivers.items() if library != name]
    # Intel's runtime works without a loader: it dispatches calls, too
    runtime = [address for name in drivers if drivers[name] == name for address in _addresses(name)]
    platforms = _listed_by_loader(libraries) if libraries else []
    return platforms + [cl.Platform.from_int_ptr(address) for address in runtime]


def _listed_by_loader(libraries):
    before, platforms = dict(os.environ), []
    with tempfile.TemporaryDirectory(prefix="pp-cl-drivers-") as folder:
        for i, library in enumerate(libraries):
            Path(folder, f"{i}.icd").write_text(f"{library}\n", "utf-8")
        if any(libraries):
            os.environ |= {"OCL_ICD_VENDORS": folder, "PYOPENCL_HOME": folder}
        with suppress(cl.Error):  # raised by a loader that finds no platform
            platforms = cl.get_platforms()
    for name in ("OCL_ICD_VENDORS", "PYOPENCL_HOME"):
        os.environ.pop(name, None)
    os.environ |= before
    return platforms


def _addresses(library):
    """The addresses of the platforms in a driver's library; [] if it cannot be loaded."""
    try:
        # WinDLL searches the library's folder for the libraries that it needs
        driver = ctypes.WinDLL(library) if sys.platform == "win32" else ctypes.CDLL(library)
        address = driver.clGetExtensionFunctionAddress
    except (OSError, AttributeError):
        return []
    address.argtypes, address.restype = [ctypes.c_char_p], ctypes.c_void_p
    prototype = ctypes.CFUNCTYPE(
        ctypes.c_int32, ctypes.c_uint32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint32)
    )
    get_platforms = prototype(address(b"clIcdGetPlatformIDsKHR"))
    count = ctypes.c_uint32()
    if get_platforms(0, None, ctypes.byref(count)):
        return []
    platforms = (ctypes.c_void_p * count.value)()
    get_platforms(count, platforms, None)
    return list(platforms)
