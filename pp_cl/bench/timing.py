"""Measures wall-clock times of runs in turn and errors against float64; makes rows of a table."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# Rounds of a measurement: at least LEAST_ROUNDS, then until SECONDS are over or MOST_ROUNDS done.
LEAST_ROUNDS, MOST_ROUNDS, SECONDS = 5, 50, 1.5


def interleave(
    runs: dict[Any, Callable], rounds: int | None = None, pause: float = 0.0
) -> dict[Any, list[float]]:
    """{name: [milliseconds]} of functions called in turn, after one round unmeasured. rounds: None:
    LEAST_ROUNDS to MOST_ROUNDS, within SECONDS. pause: seconds before each call, in which threads
    of the previous one stop spinning.
    """
    times: dict[Any, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    start, done = time.perf_counter(), 0
    while done < (rounds or LEAST_ROUNDS) or (
        not rounds and done < MOST_ROUNDS and time.perf_counter() - start < SECONDS
    ):
        for name, run in runs.items():
            time.sleep(pause)
            before = time.perf_counter()
            run()
            times[name].append((time.perf_counter() - before) * 1e3)
        done += 1
    return times


def errors(actual: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """(relative L2 error, largest difference). Raises FloatingPointError for NaN and Inf."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    if not np.isfinite(actual).all():
        raise FloatingPointError("a result holds NaN or Inf")
    difference = actual - expected
    scale = max(np.linalg.norm(expected), np.finfo(np.float32).tiny)
    return float(np.linalg.norm(difference) / scale), float(np.abs(difference).max())


def variant_rows(
    about: dict, runs: dict[str, Callable], found: dict[str, tuple], *, flops: int
) -> list[dict]:
    """A row for each variant, timed in turn. about: fields that all rows share. found: {variant:
    errors()}. flops: floating-point operations of one run, counted as direct convolutions.
    """
    return [
        {
            "variant": variant,
            **about,
            "ms": float(np.median(times)),
            "ms_range": [min(times), max(times)],
            "gflops": flops / float(np.median(times)) * 1e-6,
            "rel_l2": found[variant][0],
            "max_err": found[variant][1],
        }
        for variant, times in interleave(runs).items()
    ]


COLUMNS = "{:6} {:38} {:9} {:>9} {:>8} {:>8}  {}".format
HEAD = COLUMNS("bench", "of", "variant", "ms", "rel. L2", "max", "")


def line(row: dict) -> str:
    """A row of any bench as a line of the printed table."""
    if "layer" in row:
        what = f"{row['layer']} {'x'.join(map(str, row['shape']))} {row['direction']}"
        more = f"{row['gflops']:.1f} GFLOP/s"
    else:
        what = f"{Path(row['scene']).name} {row['points']} points, {row['size']} pixels"
        more = ", ".join(f"{name} {ms:.2f}" for name, ms in row["stages_ms"].items())
        if "host_ms" in row:
            more += f"; host, ms a step: {row['host_ms']:.2f} in {row['launches']} launches"
    variant = row["variant"] if "variant" in row else row["blend"]
    error_texts = [f"{row[key]:.1e}" if key in row else "" for key in ("rel_l2", "max_err")]
    return COLUMNS(row["bench"], what, variant, f"{row['ms']:.3f}", *error_texts, more).rstrip()
