"""The plot of the benches; matplotlib is an extra."""

from pathlib import Path
from typing import Any

from pp_cl.files.atomic import atomic_file

LEAST_ERROR = 1e-9  # an error of 0 has no logarithm: drawn there, far below float32's


def plot_time_and_error(rows: list[dict], path: str, title: str = "") -> Any:
    """Draw time against error, both logarithmic, of the rows that have one, with a colour for each
    variant of a bench, direction and blend; write the matplotlib figure, and return it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6), layout="constrained")
    figure.suptitle(title)
    axes = figure.add_subplot(xscale="log", yscale="log")
    axes.set(xlabel="milliseconds", ylabel="error against float64")
    series: dict[str, list[dict]] = {}
    for row in rows:
        if "max_err" in row:
            words = (row.get(key) for key in ("bench", "variant", "direction", "blend"))
            series.setdefault(" ".join(filter(None, words)), []).append(row)
    for number, (label, some) in enumerate(series.items()):
        errors = [max(row.get("rel_l2", row["max_err"]), LEAST_ERROR) for row in some]
        marker = "os^D"[number // 10 % 4]  # there are ten colours
        axes.plot([row["ms"] for row in some], errors, marker, label=label)
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    with atomic_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower())
    return figure
