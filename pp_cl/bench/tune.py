"""`pp-cl tune`: times what can be chosen for a network's convolutions on the device at hand.

First the blocking, one for all layers: it depends on a core's registers and caches, and the best
one was the same for every layer wherever we measured. Then, with it, every variant for every
distinct convolution and direction: a training step at the crop's size, a forward pass at the
evaluation's. Times are medians of interleaved runs, errors are against float64 (conv.py).
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.bench.conv import RandomConv
from pp_cl.bench.timing import errors, interleave
from pp_cl.device.device import Device
from pp_cl.device.discover import TEMPORARY_CACHE
from pp_cl.errors import UserError
from pp_cl.files.atomic import make_cache_folder, write_json
from pp_cl.layers.choice import (
    CHOICES,
    FORMAT,
    MARGIN,
    ConvolutionPolicy,
    ConvShape,
    device_key,
    fastest,
    make_policy,
    read_tuning,
    shipped_order,
    tuning_file,
)
from pp_cl.layers.conv_direct import Direction
from pp_cl.network.layers import Layer, computations, convolutions

# A variant is given up when even its best of PROBES runs is HOPELESS times slower than the fastest.
HOPELESS, PROBES = 3, 2
# Pixels: side of the images on which blockings are tried, whatever the network's images: they
# belong to the device.
BLOCKING_SIDE = 96
# {field of Blocking: (variant, directions) that it is tried with}
TRIED = {
    "winograd": ("winograd", (Direction.FORWARD, Direction.BACKWARD_INPUT)),
    "winograd_narrow": ("winograd", (Direction.FORWARD, Direction.BACKWARD_INPUT)),
    "winograd_weights": ("winograd", (Direction.BACKWARD_WEIGHTS,)),
    "direct": ("direct", (Direction.FORWARD, Direction.BACKWARD_INPUT)),
}


COLUMNS = "{:7} {:20} {:9} {:68} {:>8}  {}".format


@dataclass(frozen=True)
class Case:
    """A convolution in one direction, as often as the network has it.

    name: of a layer. sources: channels; of an input gradient those of its one source. side: of its
    square image, in pixels. training: part of a training step, else only of an evaluation's
    picture.
    """

    name: str
    direction: Direction
    k: int
    sources: tuple[int, ...]
    co: int
    side: int
    count: int
    training: bool

    @property
    def layer(self) -> tuple:
        """(k, side, sources, co): what a RandomConv is made of."""
        return self.k, self.side, self.sources, self.co

    @property
    def shape(self) -> ConvShape:
        """What its variant is chosen by."""
        return ConvShape(self.direction, self.k, self.sources, self.co, self.side**2)


def network_cases(layers: list[Layer], train_side: int, evaluated_side: int) -> list[Case]:
    """All distinct convolutions of a training step and of an evaluation's picture."""
    found: dict[Any, Any] = {}
    for side, training in ((train_side, True), (evaluated_side, False)):
        for layer in convolutions(layers):
            for direction, source in computations(layer, training):
                sources = layer.sources if source is None else (layer.sources[source],)
                key = (direction, layer.kernel_size, sources, layer.channels, side >> layer.level)
                name, count, before = found.get(key, (layer.name, 0, training))
                found[key] = (name, count + (training == before), before)
    return [
        Case(name, direction, k, sources, co, side, count, training)
        for (direction, k, sources, co, side), (name, count, training) in found.items()
    ]


def time_runs(runs: dict[Any, Callable]) -> dict[Any, float]:
    """{name: median milliseconds} of functions run in turn; hopeless ones run PROBES times only."""
    times = interleave(runs, rounds=PROBES)
    limit = HOPELESS * min(min(t) for t in times.values())
    times |= interleave({name: run for name, run in runs.items() if min(times[name]) <= limit})
    return {name: float(np.median(t)) for name, t in times.items()}


def tune_blocking(
    dev: Device, cases: list[Case], policy: ConvolutionPolicy
) -> tuple[dict, dict[str, dict]]:
    """({field of Blocking: value} where the shipped value is not the best, {field: {value: total
    milliseconds over the training's 3x3 layers}}).

    As in measure(), what seems faster than the shipped value must be so again.
    """
    choices = CHOICES[policy.device_class]
    totals = _time_blocking(dev, cases, choices, policy)
    best = {name: fastest(ms, choices[name][0]) for name, ms in totals.items()}
    pairs = {name: (choices[name][0], b) for name, b in best.items() if b != choices[name][0]}
    for name, ms in _time_blocking(dev, cases, pairs, policy).items():
        totals[name] |= ms
        best[name] = fastest(ms, choices[name][0])
    return {name: value for name, value in best.items() if value != choices[name][0]}, totals


def _time_blocking(dev, cases, values, policy):
    """{field of Blocking: {value: total milliseconds over the training's 3x3 layers}}."""
    totals = {}
    for case in (c for c in cases if c.training and c.k == 3):
        used = [name for name in values if case.direction in TRIED[name][1]]
        conv = RandomConv(dev, case.k, BLOCKING_SIDE, case.sources, case.co) if used else None
        for name in (name for name in used if TRIED[name][0] in conv.variants):
            runs = {
                value: conv.runner(
                    TRIED[name][0], case.direction, _with_blocking(policy, {name: value})
                )
                for value in values[name]
            }
            total = totals.setdefault(name, dict.fromkeys(values[name], 0.0))
            for value, ms in time_runs(runs).items():
                total[value] += case.count * ms
    return totals


def _with_blocking(policy, values):
    return replace(policy, blocking=replace(policy.blocking, **values))


def measure(
    case: Case, conv: RandomConv, shipped: ConvolutionPolicy, tuned: ConvolutionPolicy
) -> tuple[dict, float]:
    """(row of a tuning, milliseconds as shipped) of a case: times and errors of all variants that
    can run it, with the blocking of `tuned`.

    Those that seem faster than the shipped one must be so in a second measurement, whose times
    count: the best of several noisy numbers is too good.
    """
    order = shipped_order(shipped.device_class, case.shape)
    names = [variant for variant in conv.variants if variant in order]
    runs = {name: conv.runner(name, case.direction, tuned) for name in names}
    found = {name: errors(*conv.result(name, case.direction, tuned))[0] for name in names}
    ms = time_runs(runs)
    first = order[0]
    again: dict[Any, Callable] = {
        name: runs[name] for name in runs if name == first or ms[name] * MARGIN < ms[first]
    }
    if tuned.blocking != shipped.blocking:
        again[None] = conv.runner(first, case.direction, shipped)
    if len(again) > 1:
        ms |= time_runs(again)
    shipped_ms = ms.pop(None, ms[first])
    return {
        "direction": case.direction.value,
        "k": case.k,
        "ci": sum(case.sources),
        "co": case.co,
        "pixels": case.side**2,
        "ms": ms,
        "rel_l2": found,
    }, shipped_ms


def run_tune(
    dev: Device, cases: list[Case], tolerance: float, tell: Callable[[str], None]
) -> tuple[dict, list[float]]:
    """(tuning of this device as layers/choice.py stores it, milliseconds of the cases as shipped).

    tell: called with each line of the tables as soon as it is measured.
    """
    shipped = make_policy(dev, tolerance)
    blocking, times = tune_blocking(dev, cases, shipped)
    for name, ms in times.items():
        chosen = blocking.get(name, CHOICES[shipped.device_class][name][0])
        values = [f"{_text(v)} {m:.2f}{' (taken)' * (v == chosen)}" for v, m in ms.items()]
        tell(f"blocking of {name}, ms: {', '.join(values)}")
    tell(COLUMNS("layer", "shape", "direction", "milliseconds", "rel. L2", "taken"))
    tuned = _with_blocking(shipped, blocking)
    rows: list[dict] = []
    shipped_ms: list[float] = []
    conv: Any = None
    layer = None
    for case in cases:
        if case.layer != layer:
            conv, layer = None, case.layer  # frees the old one first
            conv = RandomConv(dev, *case.layer)
        row, as_shipped = measure(case, conv, shipped, tuned)
        rows.append(row)
        shipped_ms.append(as_shipped)
        tell(_line(dev, tolerance, case, row))
    tuning = {"format": FORMAT, "device": device_key(dev), "tile_shapes": blocking, "rows": rows}
    return tuning, shipped_ms


def _text(value):
    """8/2/1x1x1 of 8, 2, (1, 1, 1)."""
    parts = value if isinstance(value, tuple) else (value,)
    return "/".join("x".join(map(str, p)) if isinstance(p, tuple) else str(p) for p in parts)


def _line(dev, tolerance, case, row):
    """The line of a row, with the variant that is taken within the tolerance."""
    policy = make_policy(dev, tolerance, {"tile_shapes": {}, "rows": [row]})
    times = ", ".join(f"{variant} {ms:.3f}" for variant, ms in row["ms"].items())
    shape = "x".join(map(str, (case.side, case.side, row["ci"], row["co"], row["k"])))
    try:
        chosen = policy.choose(case.shape)
    except UserError:  # no variant is exact enough
        return COLUMNS(case.name, shape, row["direction"], times, "", "none")
    shipped = shipped_order(policy.device_class, case.shape)[0]
    taken = chosen if chosen == shipped else f"{chosen} instead of {shipped}"
    error = f"{row['rel_l2'][chosen]:.1e}"
    return COLUMNS(case.name, shape, row["direction"], times, error, taken)


def check_cache() -> None:
    """Raise UserError if the user's cache cannot be written, or is a temporary folder."""
    if make_cache_folder().parent.name.startswith(TEMPORARY_CACHE):
        raise UserError(
            "the user's cache cannot be written, so nothing would be kept; set PP_CACHE to a folder"
            " that stays"
        )


def store(dev: Device, tuning: dict) -> Path:
    """Write a tuning to the user's cache, merged with the one there; returns its path."""
    with suppress(OSError, ValueError):  # there is none, or one that this replaces
        tuning = merge(tuning, read_tuning(dev))
    write_json(tuning_file(dev), tuning)
    return tuning_file(dev)


def merge(tuning: dict, earlier: dict) -> dict:
    """The tuning, with the rows of an earlier one for other layers, if both were measured with the
    same blocking.
    """

    def key(row):
        return tuple(row[name] for name in ("direction", "k", "ci", "co", "pixels"))

    if earlier["tile_shapes"] != tuning["tile_shapes"]:
        return tuning
    mine = {key(row) for row in tuning["rows"]}
    return tuning | {"rows": tuning["rows"] + [r for r in earlier["rows"] if key(r) not in mine]}


def total_times(
    cases: list[Case], rows: list[dict], shipped_ms: list[float], policy: ConvolutionPolicy
) -> dict[str, tuple[float, float]]:
    """{"a training step", "a picture of the evaluation": (milliseconds as shipped, as tuned)} of
    the convolutions. Raises UserError where no variant keeps the policy's tolerance.
    """
    found: dict[str, tuple[float, float]] = {}
    for case, row, ms in zip(cases, rows, shipped_ms, strict=True):
        what = "a training step" if case.training else "a picture of the evaluation"
        shipped, tuned = found.get(what, (0.0, 0.0))
        best = row["ms"][policy.choose(case.shape)]
        found[what] = shipped + case.count * ms, tuned + case.count * best
    return found
