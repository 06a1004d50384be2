"""Figures of the benches; matplotlib is an extra."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.bench.raster import curves
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file

LEAST_ERROR = 1e-9  # an error of 0 has no logarithm: drawn there, far below float32's
OVERVIEW_SIZE = (13, 9)  # inches


def figure_of(file: str | None, option: str = "--plot") -> Any | None:
    """A matplotlib figure for a file, None where there is to be none. Raises UserError naming the
    option without matplotlib.
    """
    if not file:
        return None
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UserError(
            f"{option} {file}: needs matplotlib; install it with `pip install matplotlib`"
        ) from None
    return Figure(figsize=(8, 6), layout="constrained")


def plot_time_and_error(axes: Any, rows: list[dict]) -> None:
    """Time against error, both logarithmic: a colour for each variant, a marker for each
    direction. rows: of bench_conv() or bench_unet().
    """
    axes.set(xscale="log", yscale="log", xlabel="milliseconds", ylabel="relative L2 error")
    directions, variants = (
        list(dict.fromkeys(row[key] for row in rows)) for key in ("direction", "variant")
    )
    for (d, direction), (v, variant) in product(enumerate(directions), enumerate(variants)):
        some = [row for row in rows if (row["direction"], row["variant"]) == (direction, variant)]
        axes.plot(
            [row["ms"] for row in some],
            [max(row["rel_l2"], LEAST_ERROR) for row in some],
            "os^"[d],
            color=f"C{v}",
            label=f"{variant}, {direction}",
        )


def plot_growth(axes: Any, rows: list[dict]) -> None:
    """Time of the rasteriser against the number of points, with the least and the most. rows: of
    bench_raster().
    """
    axes.set(
        xscale="log", yscale="log", xlabel="points", ylabel="milliseconds, forward and backward"
    )
    numbers = [row["points"] for row in rows]
    axes.set_xlim(min(numbers) / 2, max(numbers) * 2)  # left to itself, one number has no width
    for c, ((size, blend), some) in enumerate(curves(rows).items()):
        ms = np.array([row["ms"] for row in some])
        least, most = np.array([row["ms_range"] for row in some]).T
        axes.errorbar(
            [row["points"] for row in some],
            ms,
            yerr=[ms - least, most - ms],
            marker="os^Dv"[c % 5],
            capsize=2,
            label=f"side {size}, {blend}",
        )


def plot_models(axes: Any, rows: list[dict]) -> None:
    """Speed against loss, a colour for each way to make a run smaller. rows: of bench_models()."""
    axes.set(xlabel="frames per second, of the first run's", ylabel="PSNR lost, dB")
    axes.set_yscale("symlog", linthresh=0.01)
    kinds = {row["what"]: row["what"].split()[0] for row in rows}
    for i, kind in enumerate(dict.fromkeys(kinds.values())):
        some = [row for row in rows if kinds[row["what"]] == kind]
        speed, loss = [row["speed"] for row in some], [row["loss"] for row in some]
        axes.plot(speed, loss, "os^Dv"[i % 5], color=f"C{i}", label=kind)


def plot_overview(figure: Any, result: dict[str, Any]) -> None:
    """What bench_overview() measured, on four axes: speed against error of the largest network,
    growth of the rasteriser, PSNR of a training, its stages.
    """
    figure.set_size_inches(OVERVIEW_SIZE)
    network, raster, quality, stages = figure.subplots(2, 2).ravel()
    side = max(row["shape"][0] for row in result["unet"])
    network.set_title(f"the network at {side} x {side}")
    plot_time_and_error(network, [row for row in result["unet"] if row["shape"][0] == side])
    raster.set_title("the rasteriser")
    plot_growth(raster, result["raster"])
    training = result["training"]
    quality.set(title="a training of the demo", xlabel="seconds", ylabel="PSNR, dB")
    curve = training["curve"]
    quality.plot([row["seconds"] for row in curve], [row["psnr"] for row in curve], marker="o")
    _plot_stages(stages, training)


def _plot_stages(axes, training):
    """A bar for each stage of a step and of a frame, the first on top."""
    axes.set(title="where its time goes", xlabel="milliseconds")
    names = list(training["step_ms"])[::-1]
    for key, label, offset in (("step_ms", "a step", 0.2), ("frame_ms", "a frame", -0.2)):
        found = [
            (i, training[key][name]["ms"]) for i, name in enumerate(names) if name in training[key]
        ]
        places, ms = zip(*found, strict=True)
        axes.barh([i + offset for i in places], ms, height=0.4, label=label)
    axes.set_yticks(range(len(names)), names)


def plot_ranks(figure: Any, names: list[str], rows: list[tuple[str, dict]], own: str) -> None:
    """A chart of horizontal bars for each of the metrics `names`, the first row on top.

    rows: [(label, {name: value})]; those without a value are left out. own: label of the row to
    mark.
    """
    for place, name in enumerate(names):
        axes = figure.add_subplot(1, len(names), place + 1, title=name.upper())
        measured = [(label, values[name]) for label, values in reversed(rows) if name in values]
        labels, values = zip(*measured, strict=True)
        colours = ["C1" if label == own else "C0" for label in labels]
        # dots, as bars that do not begin at 0 exaggerate
        axes.scatter(values, range(len(labels)), color=colours)
        axes.set_yticks(range(len(labels)), labels, fontsize="x-small")
        axes.margins(0.1)


def save_figure(figure: Any, path: str) -> None:
    """Write a figure whose axes are drawn, with a grid and a legend."""
    for axes in figure.axes:
        axes.grid(True, which="both", alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize="small")
    with atomic_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower())
