"""What `pp-cl tune` measured on a device, stored in the user's cache.

A tuning is a dictionary (JSON): FORMAT, the device's key, "tile_shapes" (fields of
blocking.Blocking that differ from the shipped ones), and rows {"direction", "k", "ci", "co",
"pixels", "ms": {variant: milliseconds}, "rel_l2": {variant: relative L2 error}}. It holds times and
errors, not choices, so that one tuning serves every tolerance (policy.py chooses). A training
stores its tuning in its checkpoint: tuning the device again changes no run under way.
"""

import json
import math
import re
import warnings
from pathlib import Path

from pp_cl import __version__
from pp_cl.device.device import Device
from pp_cl.errors import quoted, shown
from pp_cl.files.cache import cache_folder
from pp_cl.files.regular import read_regular
from pp_cl.layers.blocking import CHOICES, device_class
from pp_cl.layers.direction import Direction
from pp_cl.layers.variants import ConvShape

FORMAT = 1
MARGIN = 1.03  # another than the shipped choice must be faster by more than runs differ
DEVICE_KEY = ("platform", "name", "driver", "compute_units", "pp_cl")
MOST_BYTES = 2**24  # of a file; one device has some 100,000
LEAST, MOST = 1e-30, 2**40  # of sizes, milliseconds and errors that a measurement can give
LARGEST_RATIO = 4  # of pixels: a measurement says nothing about sizes farther away


def nearest_row(rows: list[dict], shape: ConvShape) -> dict | None:
    """The row measured for these channels at the nearest number of pixels, None if there is none
    within LARGEST_RATIO.
    """
    key = (shape.direction.value, shape.k, shape.ci, shape.co)
    near = [
        (abs(math.log(row["pixels"] / shape.pixels)), row["pixels"], row)
        for row in rows
        if (row["direction"], row["k"], row["ci"], row["co"]) == key
    ]
    distance, _, row = min(near, key=lambda r: r[:2], default=(math.inf, 0, None))
    return row if distance <= math.log(LARGEST_RATIO) * (1 + 1e-9) else None


def fastest(ms: dict, shipped: object) -> object:
    """The name with the least time; `shipped` where nothing else is faster by more than MARGIN, or
    nothing was timed.
    """
    best = min(ms, key=ms.get, default=shipped)
    return best if shipped not in ms or ms[best] * MARGIN < ms[shipped] else shipped


def device_key(dev: Device) -> dict:
    """The device, driver, number of compute units and version of pp-cl for which a tuning is
    valid.
    """
    return {name: dev.info[name] for name in DEVICE_KEY[:-1]} | {DEVICE_KEY[-1]: __version__}


def tuning_file(dev: Device) -> Path:
    """Path of the device's tuning in the user's cache."""
    words = re.sub("[^a-z0-9]+", "-", f"{dev.info['platform']} {dev.info['name']}".lower()).strip(
        "-"
    )
    return cache_folder() / f"tuning-{words}.json"


def load_tuning(dev: Device) -> dict | None:
    """The device's stored tuning, or None. A broken file, or one that is not valid for this device,
    is ignored with a one-line warning.
    """
    try:
        return read_tuning(dev)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else shown(str(error), 160)
        warnings.warn(
            f"{tuning_file(dev)}: ignored ({reason}); run `pp-cl tune` to measure anew, or"
            " delete it",
            stacklevel=2,
        )
        return None


def read_tuning(dev: Device) -> dict:
    """The device's stored tuning. Raises OSError, and ValueError for a broken file or one that is
    not valid for this device.
    """
    try:
        tuning = json.loads(read_regular(tuning_file(dev), MOST_BYTES))
    except RecursionError:
        raise ValueError("lists within lists") from None
    check_tuning(tuning, dev)
    return tuning | {"tile_shapes": stored_blocking(tuning)}


def check_tuning(tuning: dict, dev: Device) -> None:
    """Raise ValueError with the reason unless `tuning` was measured on this device as it is."""
    check_form(tuning)
    check_blocking(tuning, dev)
    for name, value in device_key(dev).items():
        if tuning["device"][name] != value:
            found = tuning["device"][name]
            found = shown(found) if isinstance(found, str) else quoted(found)
            raise ValueError(f"measured with {name} {found}, here it is {value}")


def check_blocking(tuning: dict, dev: Device) -> None:
    """Raise ValueError unless the tile shapes of a well formed `tuning` are among those of this
    class of device.
    """
    choices = CHOICES[device_class(dev)]
    for name, value in stored_blocking(tuning).items():
        if repr(value) not in map(repr, choices.get(name, ())):  # True and 1.0 are equal to 1
            raise ValueError(f"unknown tile shape {shown(name)} {quoted(value)}")


def check_form(tuning: dict) -> None:
    """Raise ValueError with the reason unless `tuning` is well formed for some device."""
    try:
        if tuning["format"] != FORMAT:
            raise ValueError(f"format {quoted(tuning['format'])}, this version reads {FORMAT}")
        if sorted(tuning["device"].keys()) != sorted(DEVICE_KEY):
            raise ValueError("it names no device")
        stored_blocking(tuning)
        if not isinstance(tuning["rows"], list):
            raise ValueError("it has no rows")
        for row in tuning["rows"]:
            _check_row(row)
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"no tuning: {type(error).__name__} {shown(str(error))}") from None


def _check_row(row):
    sizes = [row[name] for name in ("k", "ci", "co", "pixels")]
    numbers = [*row["ms"].values(), *row["rel_l2"].values()]
    if (
        row["direction"] not in {direction.value for direction in Direction}
        or not all(type(n) is int and 0 < n < MOST for n in sizes)
        or not all(type(x) in (int, float) and (x == 0 or LEAST < x < MOST) for x in numbers)
        or not row["ms"]
        or row["ms"].keys() != row["rel_l2"].keys()
    ):
        raise ValueError(f"invalid row {quoted(row)}")


def stored_blocking(tuning: dict) -> dict:
    """{field of blocking.Blocking: value} of a tuning, JSON's lists as tuples."""
    return {name: _tupled(value) for name, value in tuning["tile_shapes"].items()}


def _tupled(value):
    return tuple(_tupled(v) for v in value) if isinstance(value, list) else value
