"""OpenCL drivers and devices of this machine: which of them work, and which device is taken.

A process of its own tries all drivers: one that crashes or hangs ends that process alone, and is
named and left out.
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

RUNTIME = "intel-opencl-rt"  # Intel's CPU runtime, which the extra `cpu` brings
RUNTIME_LIBRARIES = ("libintelocl.so", "intelocl64.dll")
CHOSEN = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH")  # where users name drivers
REST = "the system's OpenCL drivers"  # where nobody tells them apart before they are loaded
SECONDS = 20  # of a driver: a first build takes 1 to 2, several times as long on a busy machine
STALE = 20  # seconds; pyopencl keeps its cache locked for milliseconds
BEGINS = "pp-cl begins with "  # the line of report() before it tries a driver
TEMPORARY_CACHE = "pp-cl-cache-"
UNSEEN = "was not seen when its driver was tried"
NONE = 4  # of what does not match a choice

LEAST_CONSTANT = 64  # bytes of constant memory, which the kernels' tables take

# A device is accepted only after this ran on it: PyPI's PoCL 3.0 is listed on current CPUs and
# fails every build.
PROBE = "kernel void probe(global float *x) { x[get_global_id(0)] *= 2.0f; }"

# {"devices": [[platform, name, version, problem or None]], "left_out": {driver: why}}
Found = dict[str, Any]
_tried: dict[str, Found] = {}  # {_kept_in() of the drivers: what this process knows of them}


# ---- devices


def open_device(choice: str | None = None) -> Device:
    """Device chosen by `choice`, else PP_DEVICE, else the fastest of those that work.

    choice: "platform:device" as printed by `pp-cl devices`, or a part of the platform's name, the
    whole or a part of the device's, in this order, as PoCL's devices carry the name of the
    processor; of several the fastest. Raises UserError when nothing matches or works.
    """
    choice = choice or os.environ.get("PP_DEVICE")
    found = list_devices()
    matches = [_match(one, choice) for one in found]
    working = [m for m, one in zip(matches, found, strict=True) if one[2] is None and m < NONE]
    if working:
        best = min(working)
        alike = [one for m, one in zip(matches, found, strict=True) if m == best]
        return Device(by_speed(alike)[0][1])
    told = [
        f"{i} {device.name.strip()} ({device.platform.name.strip()}) {problem or 'works'}"
        for i, device, problem in found
    ]
    told += [f"{driver} {problem}" for driver, problem in list_left_out()]
    listed = "; ".join(told)
    if choice and found and min(matches) == NONE:
        raise UserError(f"device {choice!r}: no such OpenCL device; found {listed}")
    asked = f"device {choice!r}: " if choice else ""
    raise UserError(f"{asked}no working OpenCL device (found {listed or 'none'}): {mend()}")


def device_line(device: Device, choice: str | None) -> str:
    """What a command says of a device, and why it is this one. choice: of open_device()."""
    chosen = choice or os.environ.get("PP_DEVICE")
    others = 0 if chosen else len(by_speed(list_devices())) - 1
    why = f", the fastest of {others + 1}" if others > 0 else ""
    return f"device: {device.name} [{device.info['platform']}]{why}"


def _match(found, choice):
    """How one of list_devices() matches `choice`, 0 the best, NONE not at all."""
    index, device, _ = found
    word, name = (choice or index).lower(), device.name.strip().lower()
    ways = word == index, word in device.platform.name.lower(), word == name, word in name
    return next((n for n, matches in enumerate(ways) if matches), NONE)


def list_devices(*, again: bool = False) -> list[Listed]:
    """[(index "platform:device", cl.Device, problem or None)] of the devices whose drivers neither
    crash nor hang. again: drivers are tried anew, also those that are known.
    """
    _give_cache()
    tried = try_drivers(again=again)
    known: dict[tuple[str, ...], list[str | None]] = {}  # of devices that are alike in their order
    for *name, problem in tried["devices"]:
        known.setdefault(tuple(name), []).append(problem)
    usable = {n: lib for n, lib in find_drivers().items() if n not in tried["left_out"]}
    found: list[Listed] = []
    for p, owner in enumerate(load_drivers(usable)):
        for d, device in enumerate(devices_of(owner)):
            problems = known.get(identity(device))
            if not problems and not again:  # another version, or a device more
                return list_devices(again=True)
            found.append((f"{p}:{d}", device, problems.pop(0) if problems else UNSEEN))
    return found


def list_left_out() -> list[tuple[str, str]]:
    """[(driver, problem)] of the drivers that crash or hang."""
    return [*try_drivers()["left_out"].items()]


def separate_devices() -> list[str]:
    """Indices "platform:device" of the devices that can work side by side: PP_DEVICE alone if set,
    else the one that open_device() takes, and where it is a GPU the others that work, each name of
    one platform. Raises UserError where nothing works.
    """
    if os.environ.get("PP_DEVICE"):
        return [os.environ["PP_DEVICE"]]
    working = by_speed(list_devices())
    if not working:
        open_device()  # says what is wrong
    if not is_gpu(working[0][1]):
        return [working[0][0]]
    owners: dict[str, str] = {}  # {name of a GPU: the platform that it is taken of}
    return [
        index
        for index, device, _ in working
        if is_gpu(device)
        and owners.setdefault(device.name.strip(), device.platform.name) == device.platform.name
    ]


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


def devices_of(platform: cl.Platform) -> list[cl.Device]:
    """The devices of a platform."""
    try:
        return platform.get_devices()
    except cl.Error:
        return []  # a platform without devices says so with an error


def find_problem(device: cl.Device) -> str | None:
    """What keeps a device from working, None if it runs a test kernel."""
    if device.max_constant_buffer_size < LEAST_CONSTANT:
        return (
            f"holds {device.max_constant_buffer_size} bytes of constants, {LEAST_CONSTANT} needed"
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
    """A temporary cache where the user's cannot be written, in which drivers and pyopencl fail;
    and none with locks of killed processes, for which pyopencl waits a minute at each build.
    """
    # pyopencl 2026.1 reads this variable, unset or not, where its cache cannot be written: KeyError
    os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")
    for lock in Path(user_cache_dir("pyopencl", "pyopencl")).glob("*/lock"):
        with suppress(OSError):  # of another process that was faster
            if time.time() - lock.stat().st_mtime > STALE:
                lock.unlink()
    if sys.platform == "win32":
        return  # which has caches elsewhere
    home = os.path.expanduser("~/.cache")
    for name, usual in (("XDG_CACHE_HOME", home), ("POCL_CACHE_DIR", "")):
        folder = os.environ.get(name) or usual
        if not folder or not (fault := _fault_of(folder)):
            continue
        # another file system may be of the same kind
        places = (tempfile.gettempdir(), "/var/tmp", os.getcwd())  # noqa: S108 - of a new folder
        place = next((place for place in places if not _fault_of(place)), None)
        temporary = os.environ[name] = tempfile.mkdtemp(prefix=TEMPORARY_CACHE, dir=place)
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        what = f"{folder}: {fault}; kernels are built again, in {temporary}"
        warnings.warn(f"{what}: set {name} to keep them", stacklevel=3)


def _fault_of(folder):
    """What keeps drivers from a cache in a folder, which is made; "" if nothing does."""
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(2**20))  # a full disk is noticed as well
    except OSError as error:
        return error.strerror
    # PoCL keeps kernels as libraries, and ends the process where it may not load them
    is_noexec = os.statvfs(folder).f_flag & getattr(os, "ST_NOEXEC", 0)
    return "is mounted noexec, so that no kernel in it runs" if is_noexec else ""


# ---- drivers: found, tried, loaded


def find_drivers() -> dict[str, str]:
    """{name: library}: of each .icd file on Linux, else "" for all that the system's loader finds;
    and of Intel's runtime beside pp-cl, whose name is its library.
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
    """The library of Intel's CPU runtime beside pp-cl: its own .icd file names another place."""
    with suppress(PackageNotFoundError):
        for file in files(RUNTIME) or []:
            if file.name in RUNTIME_LIBRARIES and (path := Path(str(file.locate()))).is_file():
                return path.resolve()
    return None


def in_conda() -> bool:
    """Whether this Python belongs to a conda environment, whose loader has drivers of its own."""
    return Path(sys.prefix, "conda-meta").is_dir()


def try_drivers(*, again: bool = False) -> Found:
    """What is found of these drivers, as kept in the user's cache; found anew where they are not
    known yet, where none works, or `again`.
    """
    drivers = find_drivers()
    file = _kept_in(drivers)
    found = {} if again else _tried.get(file) or _read(cache_folder() / file)
    if not found:
        found = _probe(drivers)
        with suppress(UserError):  # without a cache they are tried at each start
            write_json(make_cache_folder() / file, found)
    _tried[file] = found
    return found


def _kept_in(drivers):
    """The file's name of what is found of these drivers, another for other versions of them."""
    about = [cl.VERSION_TEXT]
    for names in drivers.items():
        file = next(filter(os.path.isfile, reversed(names)), None)
        about.append([*names, file and os.stat(file).st_mtime_ns])
    return f"drivers-{hashlib.sha256(json.dumps(about).encode()).hexdigest()[:16]}.json"


def _read(path):
    """What was found before; {} if nothing worked, without the file, or if it is damaged."""
    try:
        found = json.loads(path.read_text("utf-8"))
        works = any(problem is None for _, _, _, problem in found["devices"])
        return found if works and isinstance(found["left_out"], dict) else {}
    except (OSError, ValueError, TypeError, LookupError):
        return {}


def _probe(drivers):
    """What report() finds of drivers; it is started anew without each that crashes or hangs."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from pp_cl import drivers; drivers.report()"
    left_out: dict[str, str] = {}
    while True:
        tried = {name: library for name, library in drivers.items() if name not in left_out}
        command = [sys.executable, "-c", code, json.dumps(tried)]
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace"
        )
        lines = done.stdout.splitlines()
        if done.returncode == 0:  # after whatever the drivers have printed
            return {"devices": json.loads(lines[-1]), "left_out": left_out}
        begun = [line.removeprefix(BEGINS) for line in lines if line.startswith(BEGINS)]
        status = done.returncode
        how = signal.Signals(-status).name if status < 0 else f"status {status:#x}"
        is_late = "Timeout (" in done.stderr  # as faulthandler says
        why = f"does not answer within {SECONDS} seconds" if is_late else f"crashes ({how})"
        left_out |= {json.loads(begun[-1]): why} if begun else dict.fromkeys(tried, why)


def report() -> None:
    """Try the drivers in sys.argv[1], JSON of {name: library}, and print as JSON the rows of their
    devices, the name of each driver before it is tried. One that takes SECONDS ends the process.
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
    """The platforms of some drivers; the system's loader is shown no others at its first use."""
    libraries = [library for name, library in drivers.items() if library != name]
    # Intel's runtime works without a loader: it dispatches calls, too
    runtime = [address for name in drivers if drivers[name] == name for address in _addresses(name)]
    found = _listed_by_loader(libraries) if libraries else []
    return found + [cl.Platform.from_int_ptr(address) for address in runtime]


def _listed_by_loader(libraries):
    before, found = dict(os.environ), []
    with tempfile.TemporaryDirectory(prefix="pp-cl-drivers-") as folder:
        for i, library in enumerate(libraries):
            Path(folder, f"{i}.icd").write_text(f"{library}\n", "utf-8")
        if any(libraries):
            os.environ |= {"OCL_ICD_VENDORS": folder, "PYOPENCL_HOME": folder}
        with suppress(cl.Error):  # of a loader that finds none
            found = cl.get_platforms()
    for name in ("OCL_ICD_VENDORS", "PYOPENCL_HOME"):
        os.environ.pop(name, None)
    os.environ |= before
    return found


def _addresses(library):
    """Where the platforms of a driver's library lie; [] where it cannot be loaded."""
    try:
        # WinDLL finds what the library needs beside it
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
