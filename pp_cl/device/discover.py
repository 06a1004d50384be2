"""OpenCL devices: listing those that work, choosing one."""

import atexit
import os
import shutil
import tempfile
import warnings

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array

from pp_cl.device.device import Device
from pp_cl.device.launch import quiet_compiler
from pp_cl.errors import UserError

MEND = (
    "install one with `apt install pocl-opencl-icd` (Debian, Ubuntu), `conda install pocl` or your"
    " GPU vendor's driver; without root, `make setup` in a checkout puts Intel's CPU runtime into"
    " .venv"
)


TEMPORARY_CACHE = "pp-cl-cache-"


LEAST_CONSTANT = 64  # bytes of constant memory, which the kernels' tables take

# A device is accepted only after this ran on it: PyPI's PoCL 3.0 is listed on current CPUs and
# fails every build.
PROBE = "kernel void probe(global float *x) { x[get_global_id(0)] *= 2.0f; }"


def list_devices() -> list[tuple[str, cl.Device, str | None]]:
    """[(index "platform:device", cl.Device, problem or None)] of all OpenCL devices; each is probed
    with a test build.
    """
    _give_cache()
    try:
        platforms = cl.get_platforms()
    except cl.Error:
        return []
    found = []
    for p, platform in enumerate(platforms):
        try:
            devices = platform.get_devices()
        except cl.Error:
            continue  # a platform without devices says so with an error
        found += [(f"{p}:{d}", device, _probe(device)) for d, device in enumerate(devices)]
    return found


def separate_devices() -> list[str]:
    """Indices "platform:device" of the devices that can work side by side: PP_DEVICE alone if it is
    set, else the GPUs that work, else one other device. What two platforms list under one name is
    taken for one. Raises UserError where nothing works.
    """
    if os.environ.get("PP_DEVICE"):
        return [os.environ["PP_DEVICE"]]
    working = [(i, device) for i, device, problem in list_devices() if problem is None]
    gpus = {}  # name: {platform: indices}
    for index, device in working:
        if device.type & cl.device_type.GPU:
            platforms = gpus.setdefault(device.name.strip(), {})
            platforms.setdefault(device.platform.name, []).append(index)
    if gpus:
        return [index for platforms in gpus.values() for index in next(iter(platforms.values()))]
    if not working:
        open_device()  # says what is wrong
    return [working[0][0]]


def _probe(device):
    if device.max_constant_buffer_size < LEAST_CONSTANT:
        return (
            f"holds {device.max_constant_buffer_size} bytes of constants, {LEAST_CONSTANT} needed"
        )
    try:
        context = cl.Context([device])
        queue = cl.CommandQueue(context)
        x = cl_array.to_device(queue, np.arange(4, dtype=np.float32))
        with quiet_compiler():
            program = cl.Program(context, PROBE).build()
        program.probe(queue, (4,), None, x.data)
        return None if np.array_equal(x.get(), [0, 2, 4, 6]) else "computes a wrong result"
    except cl.Error as error:
        return "does not run: " + " ".join(str(error).split())[:160]


def _give_cache():
    """Drivers and pyopencl fail where the user's cache cannot be written (containers, service
    accounts): a temporary one.
    """
    # pyopencl 2026.1 reads this variable, unset or not, where its cache cannot be written: KeyError
    os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(2**20))  # a full disk is noticed as well
    except OSError as error:
        temporary = os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix=TEMPORARY_CACHE)
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        warnings.warn(
            f"{folder}: {error.strerror}; kernels are built anew: set XDG_CACHE_HOME to keep them",
            stacklevel=3,
        )


def open_device(choice: str | None = None) -> Device:
    """Device chosen by `choice`, else PP_DEVICE, else the first GPU that works, else the first
    other device that works.

    choice: "platform:device" as printed by `pp-cl devices`, or a part of the platform's or device's
    name; a platform's comes first, as PoCL's devices carry the name of the processor ("intel" means
    Intel's driver wherever there is one). Raises UserError when nothing matches or nothing works;
    never takes another device than the one asked for.
    """
    choice = choice or os.environ.get("PP_DEVICE")
    found = list_devices()
    wanted = sorted((f for f in found if _rank(f, choice)[0] < 3), key=lambda f: _rank(f, choice))
    for _, device, problem in wanted:
        if problem is None:
            return Device(device)
    listed = "; ".join(
        f"{i} {d.name.strip()} ({d.platform.name.strip()}) {problem or 'works'}"
        for i, d, problem in found
    )
    if choice and not wanted and found:
        raise UserError(f"device {choice!r}: no such OpenCL device; found {listed}")
    asked = f"device {choice!r}: " if choice else ""
    raise UserError(f"{asked}no working OpenCL device (found {listed or 'none'}): {MEND}")


def _rank(found, choice):
    """Sort key of one list_devices() entry: (0-2 how it matches `choice`, 3 not at all; GPUs
    first).
    """
    index, device, _ = found
    if not choice or choice == index:
        match = 0
    elif choice.lower() in device.platform.name.lower():
        match = 1
    else:
        match = 2 if choice.lower() in device.name.lower() else 3
    return match, not device.type & cl.device_type.GPU
