"""The picture of the benches; matplotlib is an extra."""

from pathlib import Path
from typing import Any

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file

LEAST_ERROR = 1e-9  # an error of 0 has no logarithm: drawn there, far below float32's


def figure_of(file: str | None) -> Any | None:
    """A matplotlib figure for a file, None where there is to be none. Raises UserError without
    matplotlib.
    """
    if not file:
        return None
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UserError(
            f"--plot {file}: needs matplotlib; install it with `pip install matplotlib`"
        ) from None
    return Figure(figsize=(9, 6), layout="constrained")


def plot_time_and_error(figure: Any, rows: list[dict]) -> None:
    """Time against error, both logarithmic, of the rows that have one: a colour for each variant of
    a bench, a marker for each direction or blend.
    """
    axes = figure.add_subplot(xscale="log", yscale="log")
    axes.set(xlabel="milliseconds", ylabel="error against float64")
    series: dict[tuple[str, str], list[dict]] = {}
    for row in rows:
        if "max_err" in row:
            kind = row.get("direction") or row["blend"]
            series.setdefault((f"{row['bench']} {row.get('variant', '')}", kind), []).append(row)
    variants, kinds = (list(dict.fromkeys(key[i] for key in series)) for i in (0, 1))
    for (variant, kind), some in series.items():
        axes.plot(
            [row["ms"] for row in some],
            [max(row.get("rel_l2", row["max_err"]), LEAST_ERROR) for row in some],
            "os^Dv"[kinds.index(kind) % 5],
            color=f"C{variants.index(variant) % 10}",
            label=f"{variant.strip()}, {kind}",
        )
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize="small")


def save_figure(figure: Any, path: str) -> None:
    """Write a figure."""
    with atomic_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower())
