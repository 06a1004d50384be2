"""`pp-cl bench raster`: time, bytes and error of the rasteriser's stages, by number of points,
image side and tau.

Scenes: `grid`, a ball full of points on a grid, as discs with spherical harmonics, seen like the
objects of the papers' scenes; `pulsar`, spheres of radius 0.0015 in a cube of side 1 at a depth of
1 to 2, with features of their own.

Errors are in shares of the features' range over the points seen and the background: max_err against
float64 at some pixels, tau_err against tau = 0 at all pixels, and the bound of the latter, which is
the largest weight that a pixel dropped.

Times are wall clock until the stage's work is done, in turn: all stages of all taus and the copy of
cl/bench/peak.cl once a round.
"""

import math

import numpy as np

from pp_cl.bench.network import check_files, interleave, save_figure
from pp_cl.bench.peak import Copy
from pp_cl.bench.pulsar import pulsar_row
from pp_cl.bench.raster_scenes import SCENES
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json

# Texts of the options; gamma: the last of a training, the sharpest.
DEFAULTS = {
    "scene": "grid",
    "points": "10000,63000,250000,1000000,4000000",
    "size": "200,400,800",
    "tau": "0,1e-4,1e-3,1e-2",
    "gamma": "0.01",
}
COMMON = ("project", "pairs")  # the stages before tau has a say


def bench_raster(dev, scene, points, sizes, taus, gamma):
    """Rows for every number of points, side and tau; prints them."""
    copy, rows = Copy(dev), []
    for n in points:
        for size in sizes:
            before = dev.peak_bytes = dev.bytes
            rows += _rows(dev, SCENES[scene](dev, n, size, gamma), taus, copy, before)
    return rows


def _rows(dev, bench, taus, copy, before):
    """Rows of one scene. before: device memory in use without it."""
    runs = {
        (None, name): _finished(dev, run) for name, run in bench.stages().items() if name in COMMON
    }
    for tau in taus:
        runs |= {
            (tau, name): _finished(dev, run, bench, tau)
            for name, run in bench.stages().items()
            if name not in COMMON
        }
    times = {key: float(np.median(ms)) for key, ms in interleave(runs | {"copy": copy.run}).items()}
    copied = copy.bytes / times["copy"] * 1e-6
    exact, rows = bench.features(0.0), []
    feature_range = bench.feature_range()
    for tau in taus:
        features = bench.features(tau)
        stages = {name: times.get((tau, name), times.get((None, name))) for name in bench.stages()}
        moved = bench.moved()
        forward = sum(ms for name, ms in stages.items() if name in bench.forward)
        backward = sum(ms for name, ms in stages.items() if name not in bench.forward)
        gbs = sum(moved.values()) / (forward + backward) * 1e-6
        rows.append(
            {
                "scene": bench.name,
                "points": bench.count,
                "size": bench.size,
                "gamma": bench.gamma,
                "tau": tau,
                "pairs": bench.pairs.total,
                "shaded": int(bench.weights.kept.size),
                "forward_ms": forward,
                "backward_ms": backward,
                "stages_ms": stages,
                "stages_bytes": moved,
                "gbs": gbs,
                "copy_gbs": copied,
                "copy_share": gbs / copied,
                "peak_device_bytes": dev.peak_bytes - before,
                "max_err": bench.error(features),
                "tau_err": float((np.abs(features - exact) / feature_range).max()),
                "tau_bound": float(bench.weights.dropped(bench.pairs).get().max()),
            }
        )
        print(line(rows[-1]), flush=True)
    return rows


def _finished(dev, run, bench=None, tau=None):
    """A function that sets tau, runs a stage and waits for it."""

    def finished():
        if bench:
            bench.tau = tau
        run()
        dev.finish()

    return finished


COLUMNS = "{:7} {:>8} {:>5} {:>7} {:>9} {:>9} {:>9} {:>5} {:>8} {:>8} {:>8}  {}".format
HEAD = COLUMNS(
    "scene",
    "points",
    "side",
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


def line(row):
    """One line of the printed table; times in milliseconds."""
    stages = ", ".join(f"{name} {ms:.2f}" for name, ms in row["stages_ms"].items())
    return COLUMNS(
        row["scene"],
        row["points"],
        row["size"],
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


def growth(rows):
    """[{"size", "tau", "exponent", "steepest"}]: time ~ points^exponent, fitted over all, and
    between two neighbours.
    """
    found = []
    for size, tau in dict.fromkeys((row["size"], row["tau"]) for row in rows):
        some = sorted(
            (row["points"], row["forward_ms"] + row["backward_ms"])
            for row in rows
            if (row["size"], row["tau"]) == (size, tau)
        )
        if len(some) > 1:
            n, ms = np.log(np.array(some).T)
            found.append(
                {
                    "size": size,
                    "tau": tau,
                    "exponent": float(np.polyfit(n, ms, 1)[0]),
                    "steepest": float((np.diff(ms) / np.diff(n)).max()),
                }
            )
    return found


def read_numbers(option, text, kind, least, most):
    """Numbers of a comma-separated option, ascending, each once. Raises UserError naming the
    option.
    """
    try:
        numbers = sorted({kind(float(word)) for word in text.split(",")})
    except (ValueError, OverflowError):
        numbers = []
    if not numbers or not all(math.isfinite(x) and least <= x <= most for x in numbers):
        raise UserError(
            f"{option} {text}: write numbers from {least:g} to {most:g}, separated by commas"
        )
    return numbers


def run_raster(scene, points, size, tau, gamma, json_file=None, plot_file=None, device=None):
    """Measure, print the table, write the files asked for. points, size, tau, gamma: the options'
    texts, see DEFAULTS.

    Raises UserError, before anything is measured, for options that make no sense and files that
    cannot be written.
    """
    points = read_numbers("--points", points, int, 8, 2**27)
    sizes = read_numbers("--size", size, int, 4, 4096)
    if any(side % 4 for side in sizes):
        raise UserError(f"--size {size}: write multiples of 4")
    taus = read_numbers("--tau", tau, float, 0, 0.5)
    gamma = read_numbers("--gamma", gamma, float, 1e-5, 1)
    if len(gamma) > 1:
        raise UserError("--gamma: write one number")
    figure = check_files(json_file, plot_file)
    dev = open_device(device)
    print(f"{dev.name} [{dev.info['platform']}]\n{HEAD}")
    rows = bench_raster(dev, scene, points, sizes, taus, gamma[0])
    fitted = growth(rows)
    for fit in fitted:
        print(
            f"side {fit['size']}, tau {fit['tau']:g}: time grows as points^{fit['exponent']:.2f},"
            f" at most ^{fit['steepest']:.2f} from one number to the next"
        )
    sides = sizes if scene == "pulsar" else ()
    reference = [row for n in points for side in sides if (row := pulsar_row(n, side, gamma[0]))]
    for row in reference:
        print(
            f"Pulsar (PyTorch3D, CPU): {row['points']} points, side {row['size']}: "
            f"forward {row['forward_ms']:.1f} ms, backward {row['backward_ms']:.1f} ms"
        )
    if json_file:
        result = {
            "device": dev.name,
            "platform": dev.info["platform"],
            "rows": rows + reference,
            "growth": fitted,
        }
        write_json(json_file, result)
    if figure:
        _plot(figure, f"raster, {scene}, gamma {gamma[0]:g}, {dev.name}", rows)
        save_figure(figure, plot_file)


def _plot(figure, title, rows):
    """Time against the number of points, and the errors against tau."""
    figure.suptitle(title, fontsize="medium")
    time, error = figure.subplots(1, 2)
    time.set(
        xscale="log", yscale="log", xlabel="points", ylabel="milliseconds, forward and backward"
    )
    error.set(
        xscale="log", yscale="log", xlabel="tau", ylabel="largest change of a feature / its range"
    )
    for s, size in enumerate(dict.fromkeys(row["size"] for row in rows)):
        for t, tau in enumerate(dict.fromkeys(row["tau"] for row in rows)):
            some = [row for row in rows if (row["size"], row["tau"]) == (size, tau)]
            time.plot(
                [row["points"] for row in some],
                [row["forward_ms"] + row["backward_ms"] for row in some],
                marker="os^Dv"[t % 5],
                color=f"C{s}",
                label=f"side {size}, tau {tau:g}",
            )
    dropping = [row for row in rows if row["tau"] > 0]
    for key, style, label in (("tau_err", "o", "measured"), ("tau_bound", "_", "bound")):
        error.plot(
            [row["tau"] for row in dropping],
            [max(row[key], 1e-9) for row in dropping],
            style,
            label=label,
        )
