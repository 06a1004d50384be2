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

from pp_cl.engine.device.kernel import quiet_compiler
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

Found = dict[str, Any]  # what try_drivers() returns
_tried: dict[str, Found] = {}  # {_key() of the drivers: what this process knows of them}


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


def try_drivers(*, again: bool = False) -> Found:
    """{driver: [[platform, device, version, problem or None]], or why it is left out}. What was
    found is kept in the user's cache, and found anew where these drivers are not known yet, where
    none works, or if it is asked for `again`.
    """
    drivers = find_drivers()
    key = _key(drivers)
    found = {} if again else _tried.get(key) or _read(key)
    if not found:
        found = _probe(drivers)
        with suppress(UserError):  # without a cache they are tried at each start
            write_json(make_cache_folder() / "drivers.json", [key, found])
    _tried[key] = found
    return found


def _key(drivers):
    """What another driver, or another version of one, changes."""
    about = [cl.VERSION_TEXT]
    for names in drivers.items():
        file = next(filter(os.path.isfile, reversed(names)), None)
        about.append([*names, file and os.stat(file).st_mtime_ns])
    return json.dumps(about)


def _read(key):
    """What was found of these drivers before; {} if none worked, without the file, or if it is
    damaged.
    """
    try:
        known, found = json.loads(read_regular(cache_folder() / "drivers.json", MOST_BYTES))
        rows = [row for rows in found.values() if type(rows) is list for row in rows]
        works = [problem is None for _, _, _, problem in rows]
        return found if known == key and any(works) else {}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def load(tried: Found) -> list[cl.Platform]:
    """The platforms of the drivers that neither crash nor hang."""
    return _platforms({n: lib for n, lib in find_drivers().items() if type(tried.get(n)) is list})


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


def _probe(drivers):
    """{driver: rows, or why it is left out}: each is tried by a process of its own, all at the same
    time.
    """
    end, found = time.monotonic() + SECONDS, {}
    children = {name: _start(name, library) for name, library in drivers.items()}
    for name, child in children.items():
        try:
            said, _ = child.communicate(timeout=max(0.1, end - time.monotonic()))
            if child.returncode == 0:  # after whatever the driver has printed
                found[name] = json.loads(said.splitlines()[-1])
            else:
                found[name] = _ending(child.returncode)
        except subprocess.TimeoutExpired:
            child.kill()
            found[name] = f"does not answer within {SECONDS} seconds"
    return found


def _start(name, library):
    """A process that runs report()."""
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; from pp_cl.drivers import drivers;"
        f" drivers.report({name!r}, {library!r})"
    )
    silent = {"stdin": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, **silent)


def _ending(status):
    how = signal.Signals(-status).name if status < 0 else f"status {status:#x}"
    return f"crashes ({how})"


def report(name: str, library: str) -> None:
    """Try a driver and print its rows as JSON: [[platform, device, version, problem or None]]."""
    rows = [
        [*identity(device), find_problem(device)]
        for platform in _platforms({name: library})
        for device in devices_of(platform)
    ]
    print(f"\n{json.dumps(rows)}", flush=True)  # noqa: T201 - read by _probe()
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
