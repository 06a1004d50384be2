"""Runs the cases of the selftest one by one, and writes the results as a table or as JSON."""

import os
import platform
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pyopencl

from pp_cl import __version__
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.choice import OFFERED, device_class
from pp_cl.selftest import blend, device, layers, loss, metrics, optim, raster, scene, specular
from pp_cl.selftest.case import Case

SEED = 7
COLUMNS = "{:40} {:>11} {:>9}  {}".format
HEAD = COLUMNS("case", "worst error", "bound", "pass")
HARD_COLUMNS = "{:42} {:>8} {:>8} {:>8}  {:4}  {}".format
HARD_HEAD = HARD_COLUMNS("hard case", "naive", "ours", "bound", "pass", "naive formula")
CASES: tuple[Case, ...] = (
    *device.CASES,
    *scene.CASES,
    *raster.CASES,
    *blend.CASES,
    *layers.CASES,
    *loss.CASES,
    *optim.CASES,
    *specular.CASES,
    *metrics.CASES,
)


@dataclass(frozen=True)
class Hard:
    """The naive formula of a hard case. what: how it fails. naive, error, bound: the formula's
    error (NaN if its result is NaN), our error and the bound, from the check in which the formula
    is worst.
    """

    what: str
    naive: float
    error: float
    bound: float

    def shown(self) -> list[str]:
        """The three numbers as text; errors are counts if the bound is 0."""
        form = ".2g" if self.bound else ".0f"
        return [f"{number:{form}}" for number in (self.naive, self.error, self.bound)]


@dataclass(frozen=True)
class Row:
    """The result of a case. error, bound: from its worst check; None after an exception. reason:
    one line on a failure that the numbers do not show, or "". hard: None also after an exception.
    """

    case: str
    error: float | None
    bound: float | None
    passed: bool
    reason: str
    seconds: float
    hard: Hard | None = None


def run_cases(dev: Device, cases: Iterable[Case]) -> Iterator[Row]:
    """Yield the row of each case, except for variants that are not offered to the device."""
    variants = (None, *OFFERED[device_class(dev)])
    yield from (run_case(dev, case) for case in cases if case.variant in variants)


def run_case(dev: Device, case: Case) -> Row:
    """Run a case and return its row; an exception makes it fail."""
    start = time.perf_counter()
    try:
        with np.errstate(all="ignore"):  # infinite values and NaN are results here
            checks = list(case.run(dev, np.random.default_rng(SEED)))
        worst = max(checks, key=lambda check: check.share)
    except Exception as fault:
        words = " ".join(f"{type(fault).__name__}: {fault}".split())[:300]
        return Row(case.name, None, None, False, words, time.perf_counter() - start)
    error, bound = float(worst.error), float(worst.bound)
    reason = "" if np.isfinite(error) else "NaN, Inf or a value where there may be none"
    apart, hard = max(checks, key=_naive_rank), None
    if case.hard and apart.naive is not None:
        hard = Hard(case.hard, float(apart.naive), float(apart.error), float(apart.bound))
    seconds = time.perf_counter() - start
    return Row(case.name, error, bound, error <= bound, reason, seconds, hard)


def _naive_rank(check):
    """The sort key of checks: first the naive formula's error, then ours."""
    return check.naive_share, np.nan_to_num(check.naive or 0.0, nan=np.inf), check.share


def setup(dev: Device) -> dict[str, str]:
    """{part: name or version} of the device, its driver and our software."""
    # pyopencl adds the variable's options to each build
    options = [*dev.build_options, os.environ.get("PYOPENCL_BUILD_OPTIONS", "")]
    units, gibibytes = dev.info["compute_units"], dev.info["memory_bytes"] / 2**30
    return {
        "pp-cl": __version__,
        "device": f"{dev.name} ({dev.info['type']}, {units} units, {gibibytes:.1f} GiB)",
        "platform": dev.info["platform"],
        "driver": dev.info["driver"],
        "OpenCL": dev.info["version"],
        "build options": " ".join(options).strip(),
        "system": platform.platform(),
        "Python": platform.python_version(),
        "pyopencl": pyopencl.VERSION_TEXT,
        "numpy": np.__version__,
    }


def line(row: Row) -> str:
    """A row's line in the table, followed by an indented line with the reason of a failure."""
    numbers = ["-" if n is None else f"{n:.2g}" for n in (row.error, row.bound)]
    return COLUMNS(row.case, *numbers, _passed(row)) + _reason(row)


def hard_line(row: Row) -> str:
    """A hard case's line in the table, which shows the naive formula, too."""
    hard = row.hard
    numbers = hard.shown() if hard else ["-"] * 3
    what = hard.what if hard else ""
    return HARD_COLUMNS(row.case, *numbers, _passed(row), what).rstrip() + _reason(row)


def _passed(row):
    return "yes" if row.passed else "NO"


def _reason(row):
    return f"\n    {row.reason}" if row.reason else ""


def as_json(dev: Device, rows: Iterable[Row]) -> dict[str, Any]:
    """{"setup", "passed", "seconds", "cases": [a Row's fields]}. NaN and Inf become null, but "nan"
    or "inf" for the naive formula.
    """
    rows = list(rows)
    return {
        "setup": setup(dev),
        "passed": all(row.passed for row in rows),
        "seconds": sum(row.seconds for row in rows),
        "cases": [_plain(asdict(row)) for row in rows],
    }


def _plain(row):
    """A row without numbers that JSON lacks."""
    hard = row["hard"] or {"error": 0.0, "naive": 0.0}
    for fields in (row, hard):
        fields["error"] = fields["error"] if np.isfinite(fields["error"] or 0) else None
    hard["naive"] = hard["naive"] if np.isfinite(hard["naive"]) else str(hard["naive"])
    return row
