"""OpenCL drivers: each is tried once in a process of its own, so that one that crashes or hangs is
named and left out.
"""

import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, nullcontext, suppress
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array

from pp_cl.device.launch import quiet_compiler
from pp_cl.errors import UserError
from pp_cl.files.atomic import cache_folder, make_cache_folder, write_json
from pp_cl.files.untrusted import read_regular

RUNTIME = "intel-opencl-rt"  # Intel's CPU runtime, which the extra `cpu` brings
RUNTIME_LIBRARIES = ("libintelocl.so", "intelocl64.dll")
CHOSEN = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH")  # where users name drivers
REST = "the system's OpenCL drivers"  # where nobody tells them apart before they are loaded
SECONDS = 20  # a first build takes 1 to 2, several times as long on a busy machine
MOST_BYTES = 2**20  # of the file with what was found

LEAST_CONSTANT = 64  # bytes of constant memory, which the kernels' tables take

# A device is accepted only after this ran on it: PyPI's PoCL 3.0 is listed on current CPUs and
# fails every build.
PROBE = "kernel void probe(global float *x) { x[get_global_id(0)] *= 2.0f; }"

_tried: dict[str, list[list[Any]]] = {}  # by this process, or read from the file: {key: rows}


def runtime_library() -> Path | None:
    """The library of Intel's CPU runtime if it is installed beside pp-cl. Its own .icd file names a
    place where it is not, and on Windows no loader would look for it.
    """
    with suppress(PackageNotFoundError):
        for file in files(RUNTIME) or []:
            if file.name in RUNTIME_LIBRARIES and (path := Path(str(file.locate()))).is_file():
                return path.resolve()
    return None


def find_drivers() -> dict[str, str]:
    """{name: library}: of each .icd file on Linux, else "" for all that the system's loader finds;
    and of Intel's runtime if it came with pp-cl, whose name is its library.
    """
    chosen = next((os.environ[name] for name in CHOSEN if os.environ.get(name)), "")
    drivers: dict[str, str] = {}
    if sys.platform == "linux" and (not chosen or os.path.isdir(chosen)):
        conda = Path(sys.prefix, "etc/OpenCL/vendors") if in_conda() else None
        places = [Path(chosen)] if chosen else [conda, Path("/etc/OpenCL/vendors")]
        places.append(Path(cl.__file__).parent / ".libs")
        for icd in (icd for place in places if place for icd in sorted(place.glob("*.icd"))):
            with suppress(OSError, ValueError):
                drivers[str(icd)] = read_regular(icd, 4096).strip()
    runtime = None if chosen else runtime_library()
    if not drivers and not (runtime and sys.platform == "linux"):
        drivers = {chosen or REST: ""}
    if runtime and str(runtime) not in map(os.path.realpath, drivers.values()):
        drivers[str(runtime)] = str(runtime)
    return drivers


def in_conda() -> bool:
    """Whether this Python belongs to a conda environment, whose loader has drivers of its own."""
    return Path(sys.prefix, "conda-meta").is_dir()


def try_drivers(*, again: bool = False) -> dict[str, list[list[Any]]]:
    """{driver: [[platform, device, version, problem or None]]}. A platform, or a driver, that
    crashed or hung has "" for what it did not tell. What was found is kept in the user's cache, and
    found anew where it is not known yet, where nothing works, or if it is asked for `again`.
    """
    drivers = find_drivers()
    keys = {name: _key(name, library) for name, library in drivers.items()}
    if not _tried:
        _tried.update(_read())
    unknown = [name for name in drivers if again or keys[name] not in _tried]
    works = any(row[3] is None for key in keys.values() for row in _tried.get(key, []))
    if unknown or not works:
        rows = _try({name: drivers[name] for name in (unknown if works else drivers)})
        for key in [key for key in _tried if json.loads(key)[0] in rows]:
            del _tried[key]
        _tried.update({keys[name]: found for name, found in rows.items()})
        with suppress(UserError):  # without a cache they are tried at each start
            write_json(make_cache_folder() / "drivers.json", _tried)
    return {name: _tried[keys[name]] for name in drivers}


def _key(name, library):
    """What another version of a driver changes."""
    file = next((f for f in (library, name) if os.path.isfile(f)), None)
    about = os.stat(file) if file else None
    return json.dumps(
        [name, library, about and [about.st_size, about.st_mtime_ns], cl.VERSION_TEXT]
    )


def _read():
    """What was found before; {} without the file, or if it is damaged."""
    try:
        tried = json.loads(read_regular(cache_folder() / "drivers.json", MOST_BYTES))
        sound = all(
            isinstance(json.loads(key)[0], str) and all(len(row) == 4 for row in rows)
            for key, rows in tried.items()
        )
        return tried if sound else {}
    except (OSError, ValueError, TypeError, LookupError, AttributeError):
        return {}


def left_out(tried: dict[str, list[list[Any]]]) -> list[tuple[str, str]]:
    """[(driver and platform, problem)] of what crashed or hung."""
    return [
        (f"{name} ({row[0]})" if row[0] else name, row[3])
        for name, rows in tried.items()
        for row in rows
        if not row[1] and row[3]
    ]


def load(tried: dict[str, list[list[Any]]]) -> list[cl.Platform]:
    """The platforms of the drivers that neither crash nor hang."""
    drivers = find_drivers()
    harmful = {name for name in drivers if any(row[:2] == ["", ""] for row in tried[name])}
    good = {name: library for name, library in drivers.items() if name not in harmful}
    untouched = {row[0] for rows in tried.values() for row in rows if not row[1] and row[3]}
    platforms = _platforms(good)
    return [platform for platform in platforms if platform.name.strip() not in untouched]


def _platforms(drivers):
    """The platforms of some drivers; the loader is shown no others."""
    runtime = [library for name, library in drivers.items() if library == name]
    rest = [library for name, library in drivers.items() if library != name]
    found = []
    if rest:
        with _only(rest) if any(rest) else nullcontext(), suppress(cl.Error):
            found += cl.get_platforms()  # none is an error
    return found + [platform for library in runtime for platform in _direct(library)]


@contextmanager
def _only(libraries):
    """The system's loader, which reads them at its first use, finds these drivers alone."""
    before = {name: os.environ.get(name) for name in ("OCL_ICD_VENDORS", "PYOPENCL_HOME")}
    with tempfile.TemporaryDirectory(prefix="pp-cl-drivers-") as folder:
        for i, library in enumerate(libraries):
            Path(folder, f"{i}.icd").write_text(f"{library}\n", "utf-8")
        os.environ.update(dict.fromkeys(before, folder))
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _direct(library):
    """The platforms of a driver's library, without a loader: it dispatches their calls, too."""
    # WinDLL finds what the library needs beside it
    driver = ctypes.WinDLL(library) if sys.platform == "win32" else ctypes.CDLL(library)
    address = driver.clGetExtensionFunctionAddress
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
    return [cl.Platform.from_int_ptr(platform) for platform in platforms]


def identity(device: cl.Device) -> tuple[str, str, str]:
    """Platform, name and version, by which a device is known again."""
    return device.platform.name.strip(), device.name.strip(), device.driver_version.strip()


def devices_of(platform: cl.Platform) -> list[cl.Device]:
    """The devices of a platform."""
    try:
        return platform.get_devices()
    except cl.Error:
        return []  # a platform without devices says so with an error


def _try(drivers):
    """{driver: rows}: each is tried by a process of its own, all at the same time. Where one ends
    at a platform, another goes on with the next.
    """
    rows, first = {name: [] for name in drivers}, dict.fromkeys(drivers, 0)
    while first:
        end = time.monotonic() + SECONDS
        children = {name: _start(name, drivers[name], i) for name, i in first.items()}
        try:
            for name, (child, log) in children.items():
                problem = _ending(child, end)
                lines = [json.loads(line) for line in Path(log).read_text("utf-8").splitlines()]
                begun = [line for line in lines if len(line) == 2]
                rows[name] += [line for line in lines if len(line) == 4]
                if [] in lines:
                    del first[name]
                elif begun:
                    first[name] = begun[-1][0] + 1
                    rows[name].append([begun[-1][1], "", "", problem])
                else:
                    del first[name]
                    rows[name].append(["", "", "", problem])
        finally:
            for child, log in children.values():
                child.kill()
                with suppress(OSError):  # Windows keeps what a process that hangs has open
                    os.remove(log)
    return rows


def _start(name, library, first):
    """A process that runs report(), and the file that it writes."""
    descriptor, log = tempfile.mkstemp(prefix="pp-cl-driver-")
    os.close(descriptor)
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; from pp_cl.device import drivers;"
        f" drivers.report({name!r}, {library!r}, {first}, {log!r})"
    )
    nowhere = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    return subprocess.Popen([sys.executable, "-c", code], **nowhere), log


def _ending(child, end):
    """How a process ended, at a time at the latest."""
    try:
        status = child.wait(max(0, end - time.monotonic()))
    except subprocess.TimeoutExpired:
        return f"does not answer within {SECONDS} seconds"
    how = signal.Signals(-status).name if status < 0 else f"status {status:#x}"
    return f"crashes ({how})"


def report(name: str, library: str, first: int, log: str) -> None:
    """Try a driver from its platform `first` on, and write JSON lines: [number, platform] before
    each, [platform, device, version, problem or None] after each device, [] at the end.
    """
    with open(log, "w", encoding="utf-8", buffering=1) as file:

        def say(*line):
            file.write(json.dumps(line) + "\n")

        for i, platform in enumerate(_platforms({name: library})):
            if i >= first:
                say(i, platform.name.strip())
                for device in devices_of(platform):
                    say(*identity(device), find_problem(device))
        say()
    os._exit(0)  # some drivers crash when a process ends


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
