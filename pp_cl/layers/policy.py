"""Which variant each convolution of a device takes: as measured by `pp-cl tune`, else as shipped,
and always within a tolerance.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.layers.blocking import SHIPPED, Blocking, device_class
from pp_cl.layers.tuning import (
    check_blocking,
    fastest,
    load_tuning,
    nearest_row,
    stored_blocking,
    tuning_file,
)
from pp_cl.layers.variants import VARIANTS, Convolution, ConvShape, shipped_order

AUTO = "auto"


@dataclass(frozen=True, eq=False)  # compared, and used as a key, by identity
class ConvolutionPolicy:
    """Picks a variant for each convolution.

    device_class: a key of blocking.SHIPPED. blocking: of all kernels. tolerance: largest relative
    L2 error of a layer, None = any. tuning: the stored measurements in use (tuning.py), None =
    none. variant: AUTO, or a name in VARIANTS, taken wherever it can run, without regard to
    tolerance and tuning. origin: a line that says where the choice comes from. Raises ValueError
    for an unknown variant.
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
        most tuning.LARGEST_RATIO times more or less. Where there are none, the errors are the
        registry's, and the first variant of shipped_order() that is exact enough is taken.
        """
        if self.variant != AUTO:
            can_run = VARIANTS[self.variant].can_run(shape.k, *shape.sources, shape.co)
            return self.variant if can_run else "direct"
        order = shipped_order(self.device_class, shape)
        if self.tolerance is None:
            return order[0]
        row = nearest_row(self._rows, shape) or {"ms": {}, "rel_l2": {}}
        errors = {name: row["rel_l2"].get(name, _shipped_error(name, shape)) for name in order}
        exact = [name for name in order if errors[name] <= self.tolerance]
        if not exact:
            best = min(order, key=errors.get)
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

    def convolution(self, dev: Device, shape: ConvShape) -> Convolution:
        """The chosen variant on a device. Raises UserError as choose()."""
        return VARIANTS[self.choose(shape)].convolution(dev, self.blocking)

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


def _shipped_error(name, shape):
    return VARIANTS[name].errors[shape.k][shape.direction]


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
