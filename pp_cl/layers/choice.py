"""Chooses the variant (direct, Winograd or local) of each convolution: by the times that `pp-cl
tune` measured, else by the shipped choice for the kind of device, and always within an error
tolerance.

A tuning is what `pp-cl tune` measured on a device, stored in the user's cache: a dictionary (JSON)
of FORMAT, the device's key, "tile_shapes" (fields of conv.Blocking that differ from the shipped
ones), and rows {"direction", "k", "ci", "co", "pixels", "ms": {variant: milliseconds}, "rel_l2":
{variant: relative L2 error}}. It holds times and errors, not choices, so that one tuning serves
every tolerance. A training stores its tuning in its checkpoint: tuning the device again changes no
run under way.
"""

import json
import math
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from pyopencl.array import Array

from pp_cl import __version__
from pp_cl.device.device import Device
from pp_cl.errors import UserError, quoted, shown
from pp_cl.files.atomic import cache_folder
from pp_cl.files.untrusted import read_regular
from pp_cl.layers import conv_direct, conv_local, conv_winograd
from pp_cl.layers.conv_direct import Blocking, Direction
from pp_cl.layers.tiles import VECTOR

AUTO = "auto"
FORWARD, INPUT, WEIGHTS = Direction

FORMAT = 1
MARGIN = 1.03  # another than the shipped choice must be faster by more than runs differ
DEVICE_KEY = ("platform", "name", "driver", "compute_units", "pp_cl")
MOST_BYTES = 2**24  # of a file; one device has some 100,000
LEAST, MOST = 1e-30, 2**40  # of sizes, milliseconds and errors that a measurement can give
LARGEST_RATIO = 4  # of pixels: a measurement says nothing about sizes farther away


# A CPU core has 32 vector registers. Where groups of 16 channels pair up, two share each input
# value and take 8 pixels: 16 accumulators and 6 weights; else one takes 12. A GPU's work-item has
# about 255 scalar registers, and a float16 takes 16 of them: 4 pixels.
SHIPPED = {
    "CPU": Blocking((8, 2, (1, 1, 1)), (12, 1, (1, 1, 1)), 24, (1, 1, 1)),
    "GPU": Blocking((4, 1, (16, 4, 1)), (4, 1, (16, 4, 1)), 6, None),
}
# {class of device: {field of Blocking: the values that `pp-cl tune` tries, the shipped one first}}
CHOICES: dict[str, dict[str, Any]] = {
    "CPU": {
        "winograd": ((64, 8), (32, 8), (128, 8), (64, 4), (64, 2)),
        "winograd_narrow": ((12, 12), (16, 8), (32, 8), (16, 4), (16, 2)),
        "winograd_weights": (32, 16, 64),
        "direct": ((8, 2, (1, 1, 1)), (4, 2, (1, 1, 1)), (12, 1, (1, 1, 1)), (6, 1, (1, 1, 1))),
    },
    "GPU": {
        "direct": (
            (4, 1, (16, 4, 1)),
            (4, 1, (8, 8, 1)),
            (4, 1, (32, 2, 1)),
        ),
    },
}


def device_class(dev: Device) -> str:
    """The key of a device in SHIPPED and CHOICES: "CPU", or "GPU" for every other device."""
    return "CPU" if dev.is_cpu else "GPU"


VARIANTS = {"local": conv_local, "direct": conv_direct, "winograd": conv_winograd}
# {class of device: the variants that it is offered}. By what GPU compilers say of registers and
# instructions, "local" is the faster one there, not timed; Winograd's groups would be one lane, and
# spill 15 KB of registers.
OFFERED = {"CPU": ("direct", "winograd"), "GPU": ("local", "direct")}
# {direction: pixels}: on CPUs shipped for images of at least so many. Winograd's is 2.7 times as
# fast as direct in the paper's network at 256x256, on 2 cores with AVX-512. In smaller images too
# few tiles share the cost of transforming the weights; channels matter less, from 16 on all gain.
WINOGRAD_FROM = {FORWARD: 900, INPUT: 900, WEIGHTS: 64}
# {variant: {K: {direction: bound on the relative L2 errors that `pp-cl bench conv` measured for
# K x K layers, of a ReLU's outputs or normal gradients, with up to 512 channels and 800 x 800
# pixels}}}; docs/convolutions.md has hard inputs.
_DIRECT_ERRORS = {
    3: {FORWARD: 9e-7, INPUT: 1.3e-6, WEIGHTS: 3.5e-7},
    1: {FORWARD: 3.5e-7, INPUT: 4.5e-7, WEIGHTS: 4e-7},
}
ERRORS = {
    "local": _DIRECT_ERRORS,
    "direct": _DIRECT_ERRORS,
    "winograd": {3: {FORWARD: 2.2e-6, INPUT: 2.6e-6, WEIGHTS: 8.5e-7}},
}


@dataclass(frozen=True)
class ConvShape:
    """One direction of a convolution, as far as the choice of a variant goes.

    k: side of the kernel. sources: channels of each input. co: output channels. pixels: of the
    image. source: index of the input whose gradient is computed, None in the other directions.
    """

    direction: Direction
    k: int
    sources: tuple[int, ...]
    co: int
    pixels: int
    source: int | None = None

    @property
    def ci(self) -> int:
        """Input channels; of a gradient of the input, those of its one source."""
        return sum(self.sources) if self.source is None else self.sources[self.source]


def lay_out_forward(dev: Device, module: ModuleType, weight: Array) -> Array | None:
    """A layer's weights as a module's forward() reads them, in a new array; None: as they are."""
    blocks, _, _, ci, _ = weight.shape
    floats = module.laid_out_floats(FORWARD, weight.shape, ci)
    if not floats:
        return None
    laid_out, layer = dev.empty((floats,)), (0, 0, weight.shape, None, ci, blocks * VECTOR)
    module.lay_out(dev, weight.reshape(-1), [layer], laid_out)
    return laid_out


def can_run(variant: str, k: int, *channels: int) -> bool:
    """Whether a variant takes a K x K kernel and these numbers of channels, of each source and of
    the output.
    """
    return k in ERRORS[variant] and (variant != "winograd" or conv_winograd.fits(*channels))


def shipped_order(device_class: str, shape: ConvShape) -> list[str]:
    """The variants that can run a convolution, the shipped choice first."""
    names = [n for n in OFFERED[device_class] if can_run(n, shape.k, *shape.sources, shape.co)]
    if "winograd" in names and shape.pixels >= WINOGRAD_FROM[shape.direction]:
        names.reverse()
    return names


@dataclass(frozen=True, eq=False)  # compared, and used as a key, by identity
class ConvolutionPolicy:
    """Picks a variant for each convolution.

    device_class: a key of SHIPPED. blocking: of all kernels. tolerance: largest relative L2 error
    of a layer, None = any. tuning: the stored measurements in use, None = none. variant: AUTO, or a
    name in VARIANTS, taken wherever it can run, without regard to tolerance and tuning. origin: a
    line that says where the choice comes from. Raises ValueError for an unknown variant.
    """

    device_class: str
    blocking: Blocking
    tolerance: float | None = None
    tuning: dict | None = None
    variant: str = AUTO
    origin: str = ""

    def __post_init__(self):
        if self.variant not in (AUTO, *VARIANTS):
            names = ", ".join((AUTO, *VARIANTS))
            raise ValueError(f"variant {self.variant!r}: must be one of {names}")

    def choose(self, shape: ConvShape) -> str:
        """The name of a convolution's variant. Raises UserError where none is as exact as the
        tolerance.

        Times and errors are those measured for these channels at the nearest number of pixels, at
        most LARGEST_RATIO times more or less. Where there are none, the errors are
        ERRORS, and the first variant of shipped_order() that is exact enough is taken.
        """
        if self.variant != AUTO:
            takes = can_run(self.variant, shape.k, *shape.sources, shape.co)
            return self.variant if takes else "direct"
        order = shipped_order(self.device_class, shape)
        if self.tolerance is None:
            return order[0]
        row = nearest_row(self._rows, shape) or {"ms": {}, "rel_l2": {}}
        errors = {
            name: row["rel_l2"].get(name, ERRORS[name][shape.k][shape.direction]) for name in order
        }
        exact = [name for name in order if errors[name] <= self.tolerance]
        if not exact:
            best = min(order, key=lambda name: errors[name])
            known = (
                "measured on this device"
                if best in row["rel_l2"]
                else "as shipped; `pp-cl tune` measures this device's"
            )
            raise UserError(
                f"tolerance {self.tolerance:g}: the {shape.k}x{shape.k} convolution of {shape.ci}"
                f" to {shape.co} channels ({shape.direction.value}) has an error of"
                f" {errors[best]:.2g} at least ({best}, {known});"
                f" allow {max(self._least_tolerance(), errors[best]):.2g} or more"
            )
        return fastest({name: row["ms"][name] for name in exact if name in row["ms"]}, exact[0])

    def convolution(self, shape: ConvShape) -> ModuleType:
        """The module that computes a convolution. Raises UserError as choose()."""
        return VARIANTS[self.choose(shape)]

    @property
    def _rows(self):
        return self.tuning["rows"] if self.tuning else ()

    def _least_tolerance(self):
        """The least tolerance that all measured layers can keep, rounded up to the two digits that
        are printed.
        """
        return max((_up(min(row["rel_l2"].values())) for row in self._rows), default=0.0)


def _up(value):
    """`value` rounded up to two significant digits."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return math.ceil(value / digit) * digit


def make_policy(
    dev: Device,
    tolerance: float | None = None,
    tuning: dict | None = None,
    *,
    variant: str = AUTO,
    origin: str = "",
) -> ConvolutionPolicy:
    """The policy of a device with a tuning, None = as shipped."""
    name = device_class(dev)
    blocking = replace(SHIPPED[name], **(stored_blocking(tuning) if tuning else {}))
    return ConvolutionPolicy(name, blocking, tolerance, tuning, variant, origin)


def load_policy(dev: Device, tolerance: float) -> ConvolutionPolicy:
    """The policy by the tuning in the user's cache, if there is one for this device."""
    tuning = load_tuning(dev)
    if tuning:
        origin = f"convolutions: as tuned, {tuning_file(dev)}"
    else:
        default = {
            "CPU": "as shipped for CPUs with wide vectors",
            "GPU": "direct ones through local memory; no GPU has been measured",
        }[device_class(dev)]
        origin = f"convolutions: {default}; `pp-cl tune` measures this device"
    return make_policy(dev, tolerance, tuning, origin=origin)


def policy_of_run(
    dev: Device, tolerance: float, tuning: dict | None, file: Path
) -> ConvolutionPolicy:
    """The policy by the well formed tuning, or None, with which a run began, from its checkpoint
    `file`.

    What was tuned since then changes nothing, so that a run's bits do not depend on when it was
    interrupted. Only on another device the run's tuning is of no use, and that device's own is
    loaded. Raises UserError for tile shapes that this version does not know.
    """
    if tuning is not None:
        if any(tuning["device"][name] != dev.info[name] for name in ("platform", "name")):
            return load_policy(dev, tolerance)
        try:
            check_blocking(tuning, dev)
        except ValueError as error:
            raise UserError(
                f"{file}: its tuning is broken ({error}); delete it to train anew, or restore a"
                " copy"
            ) from None
    origin = f"convolutions: {'tuned' if tuning else 'as shipped'}, as when the run began"
    return make_policy(dev, tolerance, tuning, origin=origin)


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


def fastest(ms: dict, shipped: Any) -> Any:
    """The name with the least time; `shipped` where nothing else is faster by more than MARGIN, or
    nothing was timed.
    """
    best = min(ms, key=lambda name: ms[name], default=shipped)
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
    check_form(tuning)
    check_blocking(tuning, dev)
    for name, value in device_key(dev).items():
        found = tuning["device"][name]
        if found != value:
            found = shown(found) if isinstance(found, str) else quoted(found)
            raise ValueError(f"measured with {name} {found}, here it is {value}")
    return tuning | {"tile_shapes": stored_blocking(tuning)}


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
    """{field of conv.Blocking: value} of a tuning, JSON's lists as tuples."""
    return {name: _tupled(value) for name, value in tuning["tile_shapes"].items()}


def _tupled(value):
    return tuple(_tupled(v) for v in value) if isinstance(value, list) else value
