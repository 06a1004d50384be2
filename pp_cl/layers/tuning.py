"""What `pp-cl tune` measured on a device: stored in the user's cache, and asked by every
convolution of variant "auto".

A tuning is a dictionary (JSON): FORMAT, the device's key, tile shapes, and rows {"direction", "k",
"ci", "co", "pixels", "ms": {variant: milliseconds}, "rel_l2": {variant: relative L2 error}}. It
holds what was measured, not what to take, so that one tuning serves every tolerance. A training
keeps its tuning in its checkpoint: tuning anew changes no run under way.
"""

import json
import math
import re
import sys

from pp_cl import __version__
from pp_cl.errors import UserError
from pp_cl.files.cache import cache_folder
from pp_cl.layers.variants import ERRORS, ERRORS_1X1, FASTEST

FORMAT = 1
MARGIN = 1.03  # what is shipped is left only for what is faster by more than runs differ
LARGEST_RATIO = 4  # of pixels: a measurement says nothing about sizes farther away

# The tile shapes that can be tuned, the shipped one first; by kernel file, as Device.tile_shapes
# holds them.
SHAPES = {
    "winograd": ((64, 8), (32, 8), (128, 8), (64, 4), (64, 2)),
    "winograd_weights": (32, 16, 64),
}
SHAPES_DIRECT = {
    "CPU": ((8, 2, (1, 1, 1)), (4, 2, (1, 1, 1)), (12, 1, (1, 1, 1)), (6, 1, (1, 1, 1))),
    "GPU": (
        (4, 1, (16, 4, 1)),
        (4, 1, (8, 8, 1)),
        (4, 1, (32, 2, 1)),
        (2, 1, (16, 4, 1)),
        (8, 1, (16, 4, 1)),
    ),
}


def shape_choices(dev):
    """{kernel file: the tile shapes to choose from, the shipped one first}; "direct" stands for
    conv.cl.
    """
    return SHAPES | {"direct": SHAPES_DIRECT["CPU" if dev.is_cpu else "GPU"]}


class Tuning:
    """Picks a variant for each convolution of a device, no less exact than a tolerance.

    tolerance: largest relative L2 error of a layer; rows: of a tuning, () for none.
    """

    def __init__(self, tolerance, rows=()):
        self.tolerance = tolerance
        self.rows = rows
        self._picked = {}

    def pick(self, direction, k, ci, co, pixels, order):
        """The fastest variant of `order`, which begins with the shipped choice. Raises UserError
        where none is so exact.

        Times and errors are those measured for these channels at the nearest number of pixels, at
        most LARGEST_RATIO times more or less; where there are none, errors are variants.ERRORS, and
        the first that is exact enough is taken.
        """
        key = (direction, k, ci, co, pixels)
        if key not in self._picked:
            self._picked[key] = self._pick(key, order)
        return self._picked[key]

    def _pick(self, key, order):
        row = self._nearest(*key) or {"ms": {}, "rel_l2": {}}
        errors = {name: row["rel_l2"].get(name, _shipped_error(name, *key[:2])) for name in order}
        exact = [name for name in order if errors[name] <= self.tolerance]
        if not exact:
            direction, k, ci, co, _ = key
            best = min(order, key=errors.get)
            known = (
                "measured on this device"
                if best in row["rel_l2"]
                else "as shipped; `pp-cl tune` measures this device's"
            )
            raise UserError(
                f"tolerance {self.tolerance:g}: the {k}x{k} convolution of {ci} to {co} channels"
                f" ({direction}) has an error of {errors[best]:.2g} at least ({best}, {known});"
                f" allow {max(self._least(), errors[best]):.2g} or more"
            )
        return fastest({name: row["ms"][name] for name in exact if name in row["ms"]}, exact[0])

    def _nearest(self, direction, k, ci, co, pixels):
        """The row measured for these channels at the nearest size, or None."""
        rows = [
            (abs(math.log(row["pixels"] / pixels)), row["pixels"], row)
            for row in self.rows
            if (row["direction"], row["k"], row["ci"], row["co"]) == (direction, k, ci, co)
        ]
        distance, _, row = min(rows, key=lambda r: r[:2], default=(math.inf, 0, None))
        return row if distance <= math.log(LARGEST_RATIO) * (1 + 1e-9) else None

    def _least(self):
        """The least tolerance that all measured layers can keep, rounded up to the two digits that
        are printed.
        """
        return max((_up(min(row["rel_l2"].values())) for row in self.rows), default=0.0)


def _up(value):
    """`value` rounded up to two significant digits."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return math.ceil(value / digit) * digit


def _shipped_error(name, direction, k):
    return ERRORS_1X1[direction] if k == 1 else ERRORS[direction][name]


def fastest(ms, shipped):
    """The name with the least time; `shipped` where nothing else is faster by more than MARGIN, or
    nothing was timed.
    """
    best = min(ms, key=ms.get, default=shipped)
    return best if shipped not in ms or ms[best] * MARGIN < ms[shipped] else shipped


def device_key(dev):
    """What a tuning must have been measured with to hold for a device: a driver's update ends
    it.
    """
    return {name: dev.info[name] for name in ("platform", "name", "driver", "compute_units")} | {
        "pp_cl": __version__
    }


def tuning_file(dev):
    """Path of the device's tuning in the user's cache."""
    words = re.sub("[^a-z0-9]+", "-", f"{dev.info['platform']} {dev.info['name']}".lower()).strip(
        "-"
    )
    return cache_folder() / f"tuning-{words}.json"


def load_tuning(dev):
    """The device's stored tuning, or None. One that is broken or of something else is ignored, with
    a line that says so.
    """
    try:
        return read_tuning(dev)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        reason = (
            error.strerror if isinstance(error, OSError) else " ".join(str(error).split())[:160]
        )
        print(
            f"{tuning_file(dev)}: ignored ({reason}); run `pp-cl tune` to measure anew, or"
            " delete it",
            file=sys.stderr,
        )
        return None


def read_tuning(dev):
    """The device's stored tuning. Raises OSError, and ValueError for one that is broken or of
    something else.
    """
    tuning = json.loads(tuning_file(dev).read_text("utf-8"))
    check_tuning(tuning, dev)
    return tuning | {"tile_shapes": _tupled_all(tuning["tile_shapes"])}


def check_tuning(tuning, dev):
    """Raise ValueError with the reason unless `tuning` was measured on this device as it is."""
    check_form(tuning, dev)
    for name, value in device_key(dev).items():
        if tuning["device"][name] != value:
            raise ValueError(f"measured with {name} {tuning['device'][name]}, here it is {value}")


def check_form(tuning, dev):
    """Raise ValueError with the reason unless `tuning` is one, whatever device of this kind it was
    measured on.
    """
    try:
        if tuning["format"] != FORMAT:
            raise ValueError(f"format {tuning['format']}, this version reads {FORMAT}")
        if tuning["device"].keys() != device_key(dev).keys():
            raise ValueError("it names no device")
        _check_shapes(tuning["tile_shapes"], shape_choices(dev))
        for row in tuning["rows"]:
            _check_row(row)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no tuning: {type(error).__name__} {error}") from None


def _check_shapes(given, choices):
    for name, shape in given.items():
        if _tupled(shape) not in choices.get(name, ()):
            raise ValueError(f"unknown tile shape {name} {shape}")


def _check_row(row):
    sizes = [row[name] for name in ("k", "ci", "co", "pixels")]
    numbers = [*row["ms"].values(), *row["rel_l2"].values()]
    if (
        row["direction"] not in FASTEST
        or not all(type(n) is int and n > 0 for n in sizes)
        or not all(type(x) in (int, float) and 0 <= x < math.inf for x in numbers)
        or not row["ms"]
        or row["ms"].keys() != row["rel_l2"].keys()
    ):
        raise ValueError(f"a row that cannot be: {row}")


def _tupled_all(shapes):
    return {name: _tupled(shape) for name, shape in shapes.items()}


def _tupled(shape):
    """JSON's lists as the tuples they were."""
    return tuple(_tupled(s) for s in shape) if isinstance(shape, list) else shape


def adopt(dev, tolerance, tuning):
    """Let the device's convolutions be picked by a tuning, or as shipped (None), within a
    tolerance.

    Call it before any network is made: tile shapes decide how much memory convolutions work in.
    """
    dev.tuning = Tuning(tolerance, tuning["rows"] if tuning else ())
    dev.tile_shapes = _tupled_all(tuning["tile_shapes"]) if tuning else {}


def adopt_stored(dev, tolerance):
    """adopt() with the tuning of the user's cache, saying which; returns that tuning or None."""
    tuning = load_tuning(dev)
    adopt(dev, tolerance, tuning)
    if tuning:
        print(f"convolutions: as tuned, {tuning_file(dev)}")
    else:
        default = (
            "as shipped for CPUs with wide vectors"
            if dev.is_cpu
            else "direct ones, as no GPU has been measured"
        )
        print(f"convolutions: {default}; `pp-cl tune` measures this device")
    return tuning


def adopt_of_run(dev, tolerance, tuning, file):
    """adopt() the tuning, or None, that a run began with, from its checkpoint `file`; returns the
    one adopted.

    What was tuned since then changes nothing, so that a run's bits do not depend on when it was
    interrupted. Only on another device its tuning is of no use, and that device's own is adopted.
    Raises UserError for a broken one.
    """
    if tuning is not None:
        try:
            elsewhere = any(
                tuning["device"][name] != dev.info[name] for name in ("platform", "name")
            )
            if not elsewhere:
                check_form(tuning, dev)
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"{file}: its tuning is broken ({error}); delete it to train anew, or restore a"
                " copy"
            ) from None
        if elsewhere:
            return adopt_stored(dev, tolerance)
    adopt(dev, tolerance, tuning)
    print(f"convolutions: {'tuned' if tuning else 'as shipped'}, as when the run began")
    return tuning
