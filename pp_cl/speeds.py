"""Measures once how fast OpenCL devices are, and sorts them for the choice of a device."""

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

import pyopencl as cl
from filelock import FileLock

from pp_cl.engine.device.device import Device
from pp_cl.engine.device.quirks import INTEL_PLATFORM
from pp_cl.engine.layers.choice import VARIANTS, prepared
from pp_cl.engine.layers.conv import ConvShape, packed_shape
from pp_cl.engine.layers.tiles import all_tiles
from pp_cl.errors import UserError
from pp_cl.files.atomic import make_cache_folder, write_json

# index "platform:device", cl.Device, problem or None
Listed = tuple[str, cl.Device, str | None]

SPEEDS = "speeds.json"
# Another CPU driver is preferred to Intel's only if it is this many times as fast: the whole
# demo takes PoCL longer, although some convolutions are faster with it.
CLEARLY = 2.0
SIDE, CHANNELS = 96, 64  # of the 3x3 convolution: the middle of the U-Net of `small`
SECONDS = 1.0  # per device
LONGEST = 120  # seconds until the measurement is given up; a busy machine builds kernels for 10


def identity(device: cl.Device) -> tuple[str, str, str]:
    """Platform, name and version, by which a device is recognised."""
    return device.platform.name.strip(), device.name.strip(), device.driver_version.strip()


def is_gpu(device: cl.Device) -> bool:
    """Whether the driver says that the device is a GPU."""
    return bool(device.type & cl.device_type.GPU)


def by_speed(listed: Sequence[Listed]) -> list[Listed]:
    """The devices that work, the preferred one first: the fastest, but Intel's CPU driver before
    another CPU driver that is not CLEARLY faster. If no speeds could be stored, GPUs come first,
    then Intel's.
    """
    working = [row for row in listed if row[2] is None]
    speeds = kept_speeds([device for _, device, _ in working]) if len(working) > 1 else {}
    has_intels = any(_is_intels(device) for _, device, _ in working)

    def rank(row):
        _, device, _ = row
        speed, is_intels = speeds.get(_key(device), 0.0), _is_intels(device)
        if has_intels and not is_intels and not is_gpu(device):
            speed /= CLEARLY
        return -speed, not is_gpu(device), not is_intels

    return sorted(working, key=rank)


def _is_intels(device):
    return not is_gpu(device) and device.platform.name.startswith(INTEL_PLATFORM)


def speed_of(device: cl.Device) -> float:
    """A device's speed as in kept_speeds(); 0 if it is not known."""
    return kept_speeds([device]).get(_key(device), 0.0)


def kept_speeds(devices: Sequence[cl.Device]) -> dict[str, float]:
    """{"platform, name, version": GFLOP/s} from the user's cache, {} without one. If it lacks a
    device, all devices are measured, once for all processes that ask in the meantime.
    """
    try:
        folder = make_cache_folder()
        with FileLock(folder / f"{SPEEDS}.lock"):
            speeds = _read(folder / SPEEDS)
            unknown = {_key(device) for device in devices} - speeds.keys()
            if unknown:
                speeds |= dict.fromkeys(unknown, 0.0) | _measured()
                write_json(folder / SPEEDS, speeds)
            return speeds
    except (UserError, OSError):
        return {}


def _key(device):
    return ", ".join(identity(device))


def _read(file):
    """The speeds in a file; {} if it is missing or damaged."""
    try:
        speeds = json.loads(file.read_text("utf-8"))
        return {key: float(speed) for key, speed in speeds.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _measured():
    """The result of measure() in a separate process; {} if that crashes or hangs."""
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; from pp_cl import drivers, speeds;"
        " speeds.measure(drivers.list_devices())"
    )
    words = [sys.executable, "-c", code]
    try:
        done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, timeout=LONGEST)
        return json.loads(done.stdout.splitlines()[-1])
    except (subprocess.TimeoutExpired, ValueError, LookupError):
        return {}


def measure(listed: Sequence[Listed]) -> None:
    """Print the speeds of the working devices as JSON, as in kept_speeds(). Devices take turns; the
    best time of each counts.
    """
    runs: dict[str, Callable[[], None]] = {}
    for _, device, problem in listed:
        with suppress(Exception):  # drivers may raise anything; such a device comes last
            if problem is None:
                runs[_key(device)] = _convolution(Device(device))
    seconds = dict.fromkeys(runs, math.inf)
    end = time.monotonic() + SECONDS * len(runs)
    while time.monotonic() < end:
        for key, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[key] = min(seconds[key], time.perf_counter() - start)
    flops = 2 * 9 * CHANNELS**2 * SIDE**2
    speeds = {key: round(flops * 1e-9 / took, 1) for key, took in seconds.items()}
    print(f"\n{json.dumps(speeds)}", flush=True)  # noqa: T201 - read by _measured()
    os._exit(0)  # some drivers crash when a process ends


def _convolution(dev):
    """A function that computes a convolution, after it has run once."""
    shape = ConvShape("forward", 3, (CHANNELS,), CHANNELS, (SIDE, SIDE))
    weight, bias = dev.zeros(packed_shape(3, CHANNELS, CHANNELS)), dev.zeros(CHANNELS)
    source, out = (dev.zeros((SIDE, SIDE, CHANNELS)) for _ in range(2))
    conv, tiles = prepared(dev, shape, weight, bias), all_tiles(dev, SIDE, SIDE)

    def run():
        VARIANTS[conv.variant].forward(conv, [source], out, relu=True, tiles=tiles)
        dev.finish()

    run()
    return run
