"""Figures of the benches; matplotlib is an extra."""

from pathlib import Path
from typing import Any

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file

INSTALL = "install it with `pip install 'pp-cl[plot]'`"


def figure_of(file: str | None, option: str = "--plot") -> Any | None:
    """A matplotlib figure for a file, None where there is to be none. Raises UserError naming the
    option without matplotlib.
    """
    figure = new_figure((8, 6)) if file else None
    if file and figure is None:
        raise UserError(f"{option} {file}: needs matplotlib; {INSTALL}")
    return figure


def new_figure(size: tuple[float, float]) -> Any | None:
    """An empty matplotlib figure of so many inches, None without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return None
    return Figure(figsize=size, layout="constrained")


def plot_time_and_error(figure: Any, title: str, rows: list[dict]) -> None:
    """Time against error, both logarithmic: a colour for each variant, a marker for each
    direction.
    """
    axes = figure.add_subplot(
        xscale="log", yscale="log", xlabel="milliseconds", ylabel="relative L2 error", title=title
    )
    directions, variants = (
        list(dict.fromkeys(row[key] for row in rows)) for key in ("direction", "variant")
    )
    for d, direction in enumerate(directions):
        for v, variant in enumerate(variants):
            some = [
                row for row in rows if row["direction"] == direction and row["variant"] == variant
            ]
            # an error of 0 has no logarithm: draw it far below float32's
            axes.plot(
                [row["ms"] for row in some],
                [max(row["rel_l2"], 1e-9) for row in some],
                "os^"[d],
                color=f"C{v}",
                label=f"{variant}, {direction}",
            )


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
        axes.barh(range(len(labels)), values, color=colours)
        axes.set_yticks(range(len(labels)), labels, fontsize="x-small")
        low, high = min(values), max(values)
        axes.set_xlim(max(0.0, low - 0.2 * (high - low)), high + 0.05 * (high - low) or None)


def save_figure(figure: Any, path: str) -> None:
    """Write a figure whose axes are drawn, with a grid and a legend."""
    for axes in figure.axes:
        axes.grid(True, which="both", alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize="small")
    with atomic_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower())
