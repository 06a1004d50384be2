"""Draws the plots of the benches; matplotlib is an extra."""

import math
from pathlib import Path
from typing import Any

from pp_cl.files.atomic import atomic_file

LEAST_ERROR = 1e-9  # an error of 0 has no logarithm: it is drawn here, far below float32's


# For a run's renderings: mean errors below LEAST_SEEN, a thousandth of a step of 8 bits, are drawn
# there; PSNR is drawn from BELOW dB below the default's to ABOVE dB above it.
LEAST_SEEN, BELOW, ABOVE = 4e-6, 4.0, 0.3
NEAR = 20  # pixels from a label within which another one would be written over it
# {knob of a row: its name, and how its values are written}
KNOBS = {
    "early_stop": ("early stop", "{:g}"),
    "samples": ("samples a pixel", "{}"),
    "points": ("points kept, by visibility", "{:.0%}"),
    "specular": ("specular layer off", ""),
    "members": ("members", "{}"),
    "convolutions": ("convolutions", "{}"),
    "together": ("several of these", ""),
}
CURVES = ("early_stop", "samples", "points", "members")  # knobs whose values have an order


def plot_time_and_error(rows: list[dict], path: str, title: str = "") -> Any:
    """Draw time against error, both logarithmic, for the rows that have an error, with a colour for
    each variant of a bench, direction and blend; write the matplotlib figure, and return it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6), layout="constrained")
    figure.suptitle(title, parse_math=False)  # $ in names
    axes = figure.add_subplot(xscale="log", yscale="log")
    axes.set(xlabel="milliseconds", ylabel="error against float64")
    series: dict[str, list[dict]] = {}
    for row in rows:
        if "max_err" in row:
            words = (row.get(key) for key in ("bench", "variant", "direction", "blend"))
            series.setdefault(" ".join(filter(None, words)), []).append(row)
    for number, (label, group) in enumerate(series.items()):
        errors = [max(row.get("rel_l2", row["max_err"]), LEAST_ERROR) for row in group]
        marker = "os^D"[number // 10 % 4]  # there are ten colours
        axes.plot([row["ms"] for row in group], errors, marker, label=label)
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    with atomic_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower())
    return figure


def plot_frontier(rows: list[dict], path: str, title: str = "") -> Any:
    """Draw the milliseconds of a frame against the mean error and against PSNR, for the rows of
    frontier.measured(): a curve for each knob through the default, and the frontier; write the
    matplotlib figure, and return it.
    """
    from matplotlib import rcParams
    from matplotlib.figure import Figure

    ink = rcParams["text.color"]
    figure = Figure(figsize=(13, 7), layout="constrained")
    figure.suptitle(title, parse_math=False)  # $ in names
    left, right = figure.subplots(1, 2)
    left.set(ylabel="mean error against the exact rendering (colours in 0 to 1)", yscale="log")
    right.set(ylabel="PSNR against the photographs, dB")
    (default,) = (row for row in rows if row["is_default"])
    front = sorted((row for row in rows if row["is_frontier"]), key=lambda row: row["ms"])
    right.set_ylim(default["psnr"] - BELOW, default["psnr"] + ABOVE)

    def error(row):
        return max(row["mean_err"], LEAST_SEEN)

    for axes, value in (left, error), (right, lambda row: row["psnr"]):
        axes.set(xlabel="milliseconds a frame", xlim=(0, 1.1 * max(row["ms"] for row in rows)))
        axes.grid(True, alpha=0.3)

        def draw(curve, *style, axes=axes, value=value, **options):
            axes.plot([row["ms"] for row in curve], [*map(value, curve)], *style, **options)

        for knob, (name, _) in KNOBS.items():
            knob_rows = [row for row in rows if row["knob"] == knob]
            if knob_rows and knob in CURVES:
                knob_rows = sorted([*knob_rows, default], key=lambda row: row["setting"][knob])
            draw(knob_rows, "o-" if knob in CURVES else "D", label=name if knob_rows else None)
        draw([default], "*", color=ink, markersize=14, label="default", zorder=3)
        axes.autoscale_view()
        _label(axes, default, rows, value)
    draw(front, "--", color=ink, alpha=0.5, label="frontier")  # in the plot on the right
    figure.legend(*right.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    with atomic_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower())
    return figure


def _label(axes, default, rows, value):
    """Write the values of the knobs to their marks, but none near the default or another one."""
    taken = [axes.transData.transform((default["ms"], value(default)))]
    for row in rows:
        form = KNOBS[row["knob"]][1] if row["knob"] in KNOBS else ""
        place = row["ms"], value(row)
        at = axes.transData.transform(place)
        if form and min(math.dist(at, other) for other in taken) > NEAR:
            words = form.format(row["setting"][row["knob"]])
            offset = {"xytext": (4, 3), "textcoords": "offset points"}
            axes.annotate(words, place, fontsize="small", clip_on=True, **offset)
            taken.append(at)
