"""The page of `pp-cl bench`: plots and tables of bench.json in one HTML file."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pp_cl.bench import page_plots
from pp_cl.bench.plots import INSTALL, new_figure

ABOUT = ("device", "platform", "driver", "version", "convolutions", "budget", "seconds")
FIGURE_SIZE = (9, 4)  # inches
OPEN_ROWS = 20  # longer tables are closed at first


def page_text(result: dict[str, Any]) -> str:
    """The page of what bench_overview() returns; every number on it is one of its numbers. Without
    matplotlib it has no pictures, and says so.
    """
    sections = [_section(result, section) for section in SECTIONS]
    about = [(name, _number_or_text(result[name])) for name in ABOUT]
    page = Path(__file__).with_name("page.html").read_text("utf-8")
    parts = {
        "{device}": html.escape(result["device"]),
        "{about}": _rows(about),
        "{sections}": "\n".join(sections),
    }
    for place, text in parts.items():
        page = page.replace(place, text)
    return page


# Columns: heading, key of the row (or keys of a pair), how it is written.
NETWORK = [
    ("variant", "variant", "{}"),
    ("direction", "direction", "{}"),
    ("side", "shape", "{0[0]}"),
    ("ms", "ms", "{:.2f}"),
    ("least to most", "ms_range", "{0[0]:.2f} to {0[1]:.2f}"),
    ("GFLOP/s", "gflops", "{:.1f}"),
    ("rel. L2 error", "rel_l2", "{:.1e}"),
    ("largest error", "max_err", "{:.1e}"),
]
LAYERS = [("layer", "layer", "{}"), *NETWORK]
RASTER = [
    ("blend", "blend", "{}"),
    ("tau", "tau", "{:g}"),
    ("points", "points", "{}"),
    ("side", "size", "{}"),
    ("hits", "pairs", "{}"),
    ("ms", "ms", "{:.2f}"),
    ("least to most", "ms_range", "{0[0]:.2f} to {0[1]:.2f}"),
    ("forward", "forward_ms", "{:.2f}"),
    ("backward", "backward_ms", "{:.2f}"),
    ("largest error", "max_err", "{:.1e}"),
]
GROWTH = [
    ("blend", "blend", "{}"),
    ("tau", "tau", "{:g}"),
    ("side", "size", "{}"),
    ("time grows as points^", "exponent", "{:.2f}"),
    ("at most", "steepest", "{:.2f}"),
]
CURVE = [("step", "step", "{}"), ("seconds", "seconds", "{:.1f}"), ("PSNR", "psnr", "{:.2f}")]
STAGES = [("stage", "stage", "{}"), ("ms", "ms", "{:.2f}")]
STAGES += [("least", "least", "{:.2f}"), ("most", "most", "{:.2f}")]


# Sections: title, text, what draws the picture, tables: name, rows, columns.
SECTIONS = (
    (
        "Time against error",
        "Variants of the convolutions, against float64; a line joins those that no other one beats"
        " in both. Left the layers, all that were measured added up, right the whole network.",
        page_plots.time_and_error,
        (("the network", "unet", NETWORK), ("its layers", "conv", LAYERS)),
    ),
    (
        "Where the time goes",
        "The last steps of a training of the demo, and a frame of it at 200x200 pixels. Each stage"
        " is waited for.",
        page_plots.stages,
        (("a training step", "step_ms", STAGES), ("a frame", "frame_ms", STAGES)),
    ),
    (
        "Growth with points and pixels",
        "The rasteriser, forward and backward, on a ball full of points.",
        page_plots.growth,
        (("all cases", "raster", RASTER), ("exponents", "growth", GROWTH)),
    ),
    (
        "PSNR against time",
        "A training of the demo, measured on a few of its test views; its schedules end where the"
        " budget does.",
        page_plots.psnr,
        (("the curve", "curve", CURVE),),
    ),
)


def _section(result, section):
    title, text, draw, tables = section
    parts = [f"<h2>{title}</h2>", f"<p>{html.escape(text)}</p>", _picture(draw, result, title)]
    for name, key, columns in tables:
        table = _table(_rows_of(result, key), columns)
        state = " open" if table.count("<tr>") <= OPEN_ROWS else ""
        parts.append(f"<details{state}><summary>{name}</summary>\n{table}\n</details>")
    return "\n".join(parts)


def _picture(draw, result, title):
    figure = new_figure(FIGURE_SIZE)
    if figure is None:
        return f"<p>The picture needs matplotlib: {html.escape(INSTALL)}.</p>"
    draw(figure, result)
    _add_legend(figure)
    return _image(figure, title)


def _rows_of(result, key):
    """The rows of a table."""
    if key in result:
        return result[key]
    value = result["training"][key]
    if isinstance(value, list):
        return value
    return [{"stage": name, **row} for name, row in value.items()]


def _add_legend(figure):
    """A grid on all axes, and one legend beside them."""
    labelled = {}
    for axes in figure.axes:
        axes.grid(True, which="both", alpha=0.3)
        handles, labels = axes.get_legend_handles_labels()
        labelled |= dict(zip(labels, handles, strict=True))
    if labelled:
        figure.legend(labelled.values(), labelled, loc="outside right upper", fontsize="x-small")


def _image(figure, title):
    data = io.BytesIO()
    figure.savefig(data, format="svg", metadata={"Date": None})
    encoded = base64.b64encode(data.getvalue()).decode()
    return f'<img alt="{title}" src="data:image/svg+xml;base64,{encoded}">'


def _table(rows: Iterable[dict], columns):
    head = "".join(f"<th>{heading}</th>" for heading, _, _ in columns)
    lines = [
        "".join(f"<td>{html.escape(form.format(row[key]))}</td>" for _, key, form in columns)
        for row in rows
    ]
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table>\n<tr>{head}</tr>\n{body}\n</table>"


def _rows(pairs):
    lines = (f"<tr><td>{name}</td><td>{html.escape(text)}</td></tr>" for name, text in pairs)
    return "<table>\n" + "\n".join(lines) + "\n</table>"


def _number_or_text(value):
    return value if isinstance(value, str) else f"{value:.0f} s"
