"""`pp-cl tune`: times what can be chosen for a network's convolutions on the device at hand, and
stores it (tuning.py).

First the tile shapes, one choice for all layers: they depend on a core's registers and caches, and
the best one was the same for every layer wherever we measured. Then, with these, every variant for
every distinct convolution and direction: a training step at the crop's size, a forward pass at the
evaluation's. Times are medians of interleaved runs, errors are against float64 (bench_layer.py).
"""

import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from pp_cl.bench.layer import DIRECTIONS, Layer
from pp_cl.bench.network import errors, interleave, network_shape
from pp_cl.device.discover import TEMPORARY_CACHE, open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.files.cache import make_cache_folder
from pp_cl.layers.tuning import (
    FORMAT,
    MARGIN,
    Tuning,
    device_key,
    fastest,
    read_tuning,
    shape_choices,
    tuning_file,
)
from pp_cl.layers.variants import shipped_order

# Sides of a preset's pictures, in pixels, where they are evaluated; trainings take crops of them.
EVALUATED = {"tiny": 200, "small": 400, "paper": 800}
# What takes HOPELESS times the best one's time in the best of its first PROBES runs is not run
# again.
HOPELESS, PROBES = 3, 2
# of the images that tile shapes are tried on, whatever the network's: they belong to the device
SHAPES_SIDE = 96
# What the tile shapes of a kernel file are tried with: (variant, directions).
TRIED = {
    "winograd": ("winograd4", ("forward", "input")),
    "winograd_weights": ("winograd4", ("weights",)),
    "direct": ("direct", ("forward", "input")),
}


@dataclass(frozen=True)
class Case:
    """A convolution in one direction, as often as the network has it. side: of its square image, in
    pixels.
    """

    name: str
    direction: str
    k: int
    sources: tuple  # channels; of an input gradient the one source that it is of
    co: int
    side: int
    count: int
    training: bool  # part of a training step, else of an evaluation's picture alone

    @property
    def shape(self):
        """(k, sources, co, side): what a Layer is made of."""
        return self.k, self.sources, self.co, self.side


def network_cases(widths, train_side, evaluated_side):
    """[Case] of all distinct convolutions of a training step and of an evaluation's picture."""
    steps, channels = network_shape(widths)
    found = {}

    def add(side, training, step, direction, sources):
        key = (direction, int(step.kind[-1]), sources, step.channels, side >> step.level)
        name, count, before = found.get(key, (step.name, 0, training))
        found[key] = (name, count + (training == before), before)

    for side, training, directions in (
        (train_side, True, DIRECTIONS),
        (evaluated_side, False, DIRECTIONS[:1]),
    ):
        for step in (s for s in steps if s.kind.startswith("conv")):
            sources = tuple(channels[name] for name in step.inputs)
            for direction in directions:
                for part in [(c,) for c in sources] if direction == "input" else [sources]:
                    add(side, training, step, direction, part)
    return [
        Case(name, direction, k, sources, co, side, count, training)
        for (direction, k, sources, co, side), (name, count, training) in found.items()
    ]


def time_runs(runs):
    """{name: median milliseconds} of functions run in turn, hopeless ones only a few times."""
    times = interleave(runs, rounds=PROBES)
    limit = HOPELESS * min(min(t) for t in times.values())
    times |= interleave({name: run for name, run in runs.items() if min(times[name]) <= limit})
    return {name: float(np.median(t)) for name, t in times.items()}


@contextmanager
def shaped(dev, shapes):
    """The device with other tile shapes for a while; {} = as shipped."""
    before, dev.tile_shapes = dev.tile_shapes, shapes
    try:
        yield
    finally:
        dev.tile_shapes = before


def with_shapes(layer, shapes, run):
    """`run` of the layer as a function that runs with the device's tile shapes replaced by
    `shapes`.
    """
    with shaped(layer.dev, shapes):
        work = layer.make_work()

    def changed():
        before, layer.work = layer.work, work
        with shaped(layer.dev, shapes):
            run()
        layer.work = before

    return changed


def tune_shapes(dev, cases):
    """{kernel file: tile shape} of the least total time over the training's 3x3 layers, where it is
    not the shipped one.

    As in measure(), what seems faster than the shipped shape must be so again.
    """
    totals = time_shapes(dev, cases, shape_choices(dev))
    shipped = {name: shape_choices(dev)[name][0] for name in totals}
    best = {name: fastest(ms, shipped[name]) for name, ms in totals.items()}
    pairs = {name: (shipped[name], shape) for name, shape in best.items() if shape != shipped[name]}
    for name, ms in time_shapes(dev, cases, pairs).items():
        totals[name] |= ms
        best[name] = fastest(ms, shipped[name])
    for name, ms in totals.items():
        shown = [
            f"{_text(shape)} {total:.2f}{' (taken)' if shape == best[name] else ''}"
            for shape, total in ms.items()
        ]
        print(f"tile shapes of {name}, ms: {', '.join(shown)}", flush=True)
    return {name: shape for name, shape in best.items() if shape != shipped[name]}


def time_shapes(dev, cases, shapes):
    """{kernel file: {tile shape: total milliseconds}} of the training's 3x3 layers, for some shapes
    of some files.
    """
    totals = {}
    for case in (c for c in cases if c.training and c.k == 3):
        used = [name for name in shapes if case.direction in TRIED[name][1]]
        layer = Layer(dev, case.k, SHAPES_SIDE, case.sources, case.co) if used else None
        for name in used:
            variant = TRIED[name][0]
            if variant in layer.variants:
                run = layer.runner(variant, case.direction)
                times = time_runs(
                    {shape: with_shapes(layer, {name: shape}, run) for shape in shapes[name]}
                )
                total = totals.setdefault(name, dict.fromkeys(shapes[name], 0.0))
                for shape, ms in times.items():
                    total[shape] += case.count * ms
    return totals


def _text(shape):
    """8, 2, (1, 1, 1) -> 8/2/1x1x1"""
    parts = shape if isinstance(shape, tuple) else (shape,)
    return "/".join("x".join(map(str, p)) if isinstance(p, tuple) else str(p) for p in parts)


def measure(dev, case, layer):
    """(row of a tuning, milliseconds as shipped) of a case: times and errors of all variants that
    can take it.

    Those that seem faster than the shipped one must be so in a second measurement, whose times
    count: the best of several noisy numbers is too good.
    """
    shipped = shipped_variant(dev, case)
    runs = {
        variant: layer.runner(variant, case.direction)
        for variant in layer.variants
        if variant in _order(dev, case)
    }
    found = {variant: errors(*layer.result(variant, case.direction))[0] for variant in runs}
    ms = time_runs(runs)
    again = {
        name: runs[name] for name in runs if name == shipped or ms[name] * MARGIN < ms[shipped]
    }
    if dev.tile_shapes:
        again[None] = with_shapes(layer, {}, runs[shipped])
    if len(again) > 1:
        ms |= time_runs(again)
    shipped_ms = ms.pop(None, ms[shipped])
    return {
        "direction": case.direction,
        "k": case.k,
        "ci": sum(case.sources),
        "co": case.co,
        "pixels": case.side**2,
        "ms": ms,
        "rel_l2": found,
    }, shipped_ms


def tune_layers(dev, cases, tolerance):
    """(rows of all cases, their milliseconds as shipped); prints each, with what is taken within
    the tolerance.
    """
    rows, shipped_ms, layer, shape = [], [], None, None
    for case in cases:
        if case.shape != shape:
            layer, shape = None, case.shape  # one at a time
            layer = Layer(dev, case.k, case.side, case.sources, case.co)
        row, ms = measure(dev, case, layer)
        rows.append(row)
        shipped_ms.append(ms)
        try:
            taken = picked(dev, case, Tuning(tolerance, [row]))
        except UserError:
            taken = None
        print(line(case, row, taken, shipped_variant(dev, case)), flush=True)
    return rows, shipped_ms


def _order(dev, case):
    return shipped_order(dev, case.direction, case.k, (*case.sources, case.co), case.side**2)


def shipped_variant(dev, case):
    """The variant that is shipped for a case."""
    return _order(dev, case)[0]


def picked(dev, case, tuning):
    """The variant that a tuning picks for a case."""
    return tuning.pick(
        case.direction, case.k, sum(case.sources), case.co, case.side**2, _order(dev, case)
    )


def summary(dev, cases, rows, shipped_ms, tuning):
    """Lines that say what the tuning gains. Raises UserError where no variant keeps its
    tolerance.
    """
    lines = []
    for training, what in ((True, "a training step"), (False, "a picture of the evaluation")):
        some = [
            (c, row, ms)
            for c, row, ms in zip(cases, rows, shipped_ms, strict=True)
            if c.training == training
        ]
        shipped = sum(c.count * ms for c, _, ms in some)
        tuned = sum(c.count * row["ms"][picked(dev, c, tuning)] for c, row, _ in some)
        if some:
            lines.append(
                f"convolutions of {what}: {shipped:.2f} ms as shipped, {tuned:.2f} ms as tuned, "
                f"{shipped / tuned:.2f} times as fast"
            )
    return lines


COLUMNS = "{:7} {:20} {:9} {:68} {:>8}  {}".format
HEAD = COLUMNS("layer", "shape", "direction", "milliseconds", "rel. L2", "taken")


def line(case, row, taken, shipped):
    """One line of the printed table; taken: None where no variant is exact enough."""
    ms = ", ".join(f"{name} {ms:.3f}" for name, ms in row["ms"].items())
    shape = f"{case.side}x{case.side}x{row['ci']}x{case.co}x{case.k}"
    if taken is None:
        return COLUMNS(case.name, shape, case.direction, ms, "", "none")
    return COLUMNS(
        case.name,
        shape,
        case.direction,
        ms,
        f"{row['rel_l2'][taken]:.1e}",
        taken if taken == shipped else f"{taken} instead of {shipped}",
    )


def merge(tuning, earlier):
    """The tuning, with the rows of an earlier one for other layers, if both were measured with the
    same tile shapes.
    """
    if earlier["tile_shapes"] != tuning["tile_shapes"]:
        return tuning
    mine = {_key(row) for row in tuning["rows"]}
    return tuning | {
        "rows": tuning["rows"] + [row for row in earlier["rows"] if _key(row) not in mine]
    }


def _key(row):
    return tuple(row[name] for name in ("direction", "k", "ci", "co", "pixels"))


def run_tune(widths, train_side, evaluated_side, tolerance, device=None):
    """Measure a network's convolutions, print the tables, store the tuning.

    Raises UserError, before anything is measured, where it cannot be stored; and where no variant
    keeps the tolerance.
    """
    dev = open_device(device)
    if make_cache_folder().parent.name.startswith(TEMPORARY_CACHE):
        raise UserError(
            "the user's cache cannot be written, so nothing would be kept; set PP_CACHE to a folder"
            " that stays"
        )
    print(
        f"{dev.name} [{dev.info['platform']}], widths {','.join(map(str, widths))}, "
        f"training at {train_side}x{train_side}, evaluation at {evaluated_side}x{evaluated_side}"
    )
    start, cases = time.perf_counter(), network_cases(widths, train_side, evaluated_side)
    dev.tile_shapes = tune_shapes(dev, cases)
    print(HEAD)
    rows, shipped_ms = tune_layers(dev, cases, tolerance)
    tuning = {
        "format": FORMAT,
        "device": device_key(dev),
        "tile_shapes": dev.tile_shapes,
        "rows": rows,
    }
    with suppress(OSError, ValueError):  # there is none, or one that this replaces
        tuning = merge(tuning, read_tuning(dev))
    write_json(tuning_file(dev), tuning)
    print(f"stored in {tuning_file(dev)} ({time.perf_counter() - start:.0f} s)")
    print("\n".join(summary(dev, cases, rows, shipped_ms, Tuning(tolerance, rows))))
