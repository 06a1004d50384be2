"""`pp-cl bench raster`: time, bytes and error of the rasteriser's stages, by number of points,
image side, blend and tau.

Scenes: `grid`, a ball full of points on a grid, as discs with spherical harmonics, seen like the
objects of the papers' scenes; `pulsar`, spheres of radius 0.0015 in a cube of side 1 at a depth of
1 to 2, with features of their own.

Errors are in shares of the features' range over the points seen and the background: max_err against
float64 at some pixels, tau_err against tau = 0 at all pixels, and the bound of the latter, which is
the largest weight that a pixel dropped.

Times are wall clock until the stage's work is done, in turn: all stages of all cases and the copy
of cl/bench/peak.cl once a round.
"""

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from pp_cl.bench.peak import CopyBandwidth
from pp_cl.bench.raster_scenes import SCENES, Case
from pp_cl.bench.timing import interleave
from pp_cl.device.device import Device


def bench_raster(
    dev: Device,
    scene: str,
    points: list[int],
    sizes: list[int],
    *,
    cases: list[Case],
    gamma: float,
) -> Iterator[dict]:
    """Yield a row for every number of points, side and case. scene: a key of SCENES."""
    copy = CopyBandwidth(dev)
    for n in points:
        for size in sizes:
            before = dev.reset_peak()
            yield from _rows(
                dev, SCENES[scene](dev, n, size, gamma), cases, copy=copy, before=before
            )


def _rows(dev, bench, cases, *, copy, before):
    """Rows of one scene."""
    stages_ms, whole_ms = _time(dev, bench, cases, copy)
    copied = copy.bytes / np.median(whole_ms["copy"]) * 1e-6
    exact = {
        blend: bench.forward(Case(blend, 0.0)).features.get()
        for blend in dict.fromkeys(case.blend for case in cases)
    }
    # both rasterise the scene when they are first read: not inside the loop, which does so too
    feature_range, _ = bench.feature_range, bench.covered_pixels
    for case in cases:
        result, stages = bench.forward(case), stages_ms[case]
        features, moved = result.features.get(), bench.moved_bytes(case, result)
        forward = sum(ms for name, ms in stages.items() if name in bench.forward_stages)
        backward = sum(stages.values()) - forward
        gbs = sum(moved.values()) / (forward + backward) * 1e-6
        yield {
            "scene": bench.name,
            "points": bench.count,
            "size": bench.size,
            "gamma": bench.gamma,
            "blend": case.blend,
            "tau": case.tau,
            "pairs": result.pairs.total,
            "shaded": int(result.shaded.size),
            "forward_ms": forward,
            "backward_ms": backward,
            "ms": float(np.median(whole_ms[case])),
            "ms_range": [min(whole_ms[case]), max(whole_ms[case])],
            "stages_ms": stages,
            "stages_bytes": moved,
            "gbs": gbs,
            "copy_gbs": float(copied),
            "copy_share": float(gbs / copied),
            "peak_device_bytes": dev.peak_bytes - before,
            "max_err": bench.error(case, features),
            "tau_err": float((np.abs(features - exact[case.blend]) / feature_range).max()),
            "tau_bound": float(bench.dropped_weights(case, result).max()),
        }


def _time(dev, bench, cases, copy):
    """({case: {stage: median milliseconds}}, {case or "copy": all its milliseconds}), all in
    turn.
    """
    seconds = {case: defaultdict(list) for case in cases}

    def runner(case):
        def run():
            with dev.timed_stages() as stages:
                bench.backward(case, bench.forward(case))
            for name, values in stages.items():
                seconds[case][name] += values

        return run

    times = interleave({case: runner(case) for case in cases} | {"copy": copy.run})
    medians = {
        case: {name: float(np.median(values[1:])) * 1e3 for name, values in stages.items()}
        for case, stages in seconds.items()  # the first pass, which builds programs, does not count
    }
    return medians, times


COLUMNS = "{:7} {:>8} {:>5} {:7} {:>7} {:>9} {:>9} {:>9} {:>5} {:>8} {:>8} {:>8}  {}".format
HEAD = COLUMNS(
    "scene",
    "points",
    "side",
    "blend",
    "tau",
    "shaded",
    "forward",
    "backward",
    "copy",
    "max err",
    "tau err",
    "bound",
    "stages",
)


def line(row: dict) -> str:
    """One line of the printed table; times in milliseconds."""
    stages = ", ".join(f"{name} {ms:.2f}" for name, ms in row["stages_ms"].items())
    return COLUMNS(
        row["scene"],
        row["points"],
        row["size"],
        row["blend"],
        f"{row['tau']:g}",
        row["shaded"],
        f"{row['forward_ms']:.2f}",
        f"{row['backward_ms']:.2f}",
        f"{row['copy_share']:.0%}",
        f"{row['max_err']:.1e}",
        f"{row['tau_err']:.1e}",
        f"{row['tau_bound']:.1e}",
        stages,
    )


def growth(rows: list[dict]) -> list[dict]:
    """[{"size", "blend", "tau", "exponent", "steepest"}]: time ~ points^exponent, fitted over all,
    and between two neighbours.
    """
    found = []
    for curve in dict.fromkeys(map(_curve, rows)):
        some = sorted(
            (row["points"], row["forward_ms"] + row["backward_ms"])
            for row in rows
            if _curve(row) == curve
        )
        if len(some) > 1:
            n, ms = np.log(np.array(some).T)
            found.append(
                {
                    **dict(zip(("size", "blend", "tau"), curve, strict=True)),
                    "exponent": float(np.polyfit(n, ms, 1)[0]),
                    "steepest": float((np.diff(ms) / np.diff(n)).max()),
                }
            )
    return found


def _curve(row):
    return row["size"], row["blend"], row["tau"]


def plot(figure: Any, title: str, rows: list[dict]) -> None:
    """Draw time against the number of points, and the errors against tau. figure: matplotlib's."""
    figure.suptitle(title, fontsize="medium")
    time, error = figure.subplots(1, 2)
    time.set(
        xscale="log", yscale="log", xlabel="points", ylabel="milliseconds, forward and backward"
    )
    error.set(
        xscale="log", yscale="log", xlabel="tau", ylabel="largest change of a feature / its range"
    )
    for c, curve in enumerate(dict.fromkeys(map(_curve, rows))):
        some = [row for row in rows if _curve(row) == curve]
        size, blend, tau = curve
        time.plot(
            [row["points"] for row in some],
            [row["forward_ms"] + row["backward_ms"] for row in some],
            marker="os^Dv"[c % 5],
            color=f"C{c}",
            label=f"side {size}, {blend}, tau {tau:g}",
        )
    dropping = [row for row in rows if row["tau"] > 0]
    for key, style, label in (("tau_err", "o", "measured"), ("tau_bound", "_", "bound")):
        error.plot(
            [row["tau"] for row in dropping],
            [max(row[key], 1e-9) for row in dropping],
            style,
            label=label,
        )
