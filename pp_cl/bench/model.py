"""`pp-cl bench model`: frames per second against PSNR of trained runs, each way of making them
smaller or faster by itself.

PSNR is over a few test views, speed against the first run as it was trained, frame by frame in
turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from pp_cl.compress.reduction import Original, Reduction, measured_psnr, nbytes
from pp_cl.compress.search import frame_ms
from pp_cl.layers.choice import OFFERED, device_class
from pp_cl.run import Run

VIEWS = 8
# Fields of Reduction and what they are set to, one at a time.
TRIED = {
    "keep": (0.9, 0.75, 0.5, 0.25),
    "half": (True,),
    "channels": (0.001, 0.01, 0.1),
    "degree": (1, 0),
    "early_stop": (0.01, 0.03, 0.1),
}
COLUMNS = "{:28} {:>9} {:>9} {:>8} {:>8} {:>7} {:>7}".format
HEAD = COLUMNS("what", "points", "MiB", "PSNR", "loss", "ms", "speed")


def bench_models(runs: list[Run]) -> Iterator[dict[str, Any]]:
    """Rows of the first run, of the others, and of the first one's reductions: {"what", "points",
    "bytes", "psnr", "loss", "ms", "speed"}.
    """
    first = runs[0]
    scene = first.scene("test").splits["test"]
    count = min(VIEWS, len(scene))
    views = [scene[i * len(scene) // count] for i in range(count)]
    whole = measured_psnr(first, views)

    def row(what, run):
        psnr = whole if run is first else measured_psnr(run, views)
        before, ms = frame_ms([first, run], views)
        return {
            "what": what,
            "points": run.model.cloud.count,
            "bytes": nbytes(run),
            "psnr": psnr,
            "loss": whole - psnr,
            "ms": ms,
            "speed": before / ms,
        }

    for run in runs:
        yield row(str(run.folder), run)
    original = Original.of(first)
    for what, reduction in _reductions(first):
        yield row(what, original.reduced(reduction))
    for name in OFFERED[device_class(first.dev)]:
        run = original.reduced(Reduction.of(first))
        run.model.net.variant = name
        yield row(f"convolutions by {name}", run)


def _reductions(run):
    """(what it is, Reduction) of each value that the run does not have yet."""
    present = Reduction.of(run)
    for name, values in TRIED.items():
        for value in values:
            if (name == "degree" and value >= present.degree) or value == getattr(present, name):
                continue
            what = name if value is True else f"{name} {value}"
            yield what, replace(present, **{name: value})


def line(row: dict[str, Any]) -> str:
    """One line of the printed table."""
    return COLUMNS(
        row["what"],
        row["points"],
        f"{row['bytes'] / 2**20:.1f}",
        f"{row['psnr']:.2f}",
        f"{row['loss']:.3f}",
        f"{row['ms']:.1f}",
        f"{row['speed']:.2f}",
    )
