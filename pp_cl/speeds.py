"""How fast OpenCL devices are, measured once, and which one is taken."""

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
# Another driver of CPUs is taken before Intel's only where it is so many times as fast: README says
# that the whole demo takes PoCL 5 % longer, though some convolutions are faster with it.
CLEARLY = 2.0
SIDE, CHANNELS = 96, 64  # of the convolution, 3x3: the middle of the U-Net of `small`
SECONDS = 1.0  # of a device
LONGEST = 120  # seconds until the measurement is given up; a busy machine builds kernels for 10


def identity(device: cl.Device) -> tuple[str, str, str]:
    """Platform, name and version, by which a device is known again."""
    return device.platform.name.strip(), device.name.strip(), device.driver_version.strip()


def is_gpu(device: cl.Device) -> bool:
    """Whether the driver says so."""
    return bool(device.type & cl.device_type.GPU)


def by_speed(found: Sequence[Listed]) -> list[Listed]:
    """Those that work, the one that is taken first: the fastest, but Intel's driver of CPUs before
    another that is not CLEARLY faster. Where no speed could be kept, GPUs first, then Intel's.
    """
    working = [one for one in found if one[2] is None]
    speeds = kept_speeds([device for _, device, _ in working]) if len(working) > 1 else {}
    has_intels = any(_is_intels(device) for _, device, _ in working)

    def rank(one):
        _, device, _ = one
        speed, is_intels = speeds.get(_key(device), 0.0), _is_intels(device)
        if has_intels and not is_intels and not is_gpu(device):
            speed /= CLEARLY
        return -speed, not is_gpu(device), not is_intels

    return sorted(working, key=rank)


def _is_intels(device):
    return not is_gpu(device) and device.platform.name.startswith(INTEL_PLATFORM)


def kept_speeds(devices: Sequence[cl.Device]) -> dict[str, float]:
    """{"platform, name, version": GFLOP/s} as kept in the user's cache, {} without one. Where a
    device is not known there, all are measured, once for all processes that ask meanwhile.
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
    """What is kept in a file; {} without it, or if it is damaged."""
    try:
        speeds = json.loads(file.read_text("utf-8"))
        return {key: float(speed) for key, speed in speeds.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _measured():
    """What measure() finds in a process of its own; {} if that crashes or hangs."""
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


def measure(found: Sequence[Listed]) -> None:
    """Print as JSON kept_speeds() of the devices that work, which take turns; the best counts."""
    runs: dict[str, Callable[[], None]] = {}
    for _, device, problem in found:
        with suppress(Exception):  # of a driver: a device that cannot do it comes last
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
    """A function that computes one, which is done once."""
    shape = ConvShape("forward", 3, (CHANNELS,), CHANNELS, (SIDE, SIDE))
    weight, bias = dev.zeros(packed_shape(3, CHANNELS, CHANNELS)), dev.zeros(CHANNELS)
    source, out = (dev.zeros((SIDE, SIDE, CHANNELS)) for _ in range(2))
    conv, tiles = prepared(dev, shape, weight, bias), all_tiles(dev, SIDE, SIDE)

    def run():
        VARIANTS[conv.variant].forward(conv, [source], out, relu=True, tiles=tiles)
        dev.finish()

    run()
    return run
