"""Times of runs in turn, rows of what was timed, and errors against float64.

Times are wall clock, launches included: every run once a round, so that a machine that slows down
slows all of them.
"""

import time
from collections.abc import Callable

import numpy as np

from pp_cl.bench.peak import PeakFlops

# Rounds of a measurement: at least LEAST_ROUNDS, then until SECONDS are over or MOST_ROUNDS done.
LEAST_ROUNDS, MOST_ROUNDS, SECONDS = 5, 50, 1.5


def interleave(
    runs: dict[object, Callable], rounds: int | None = None, pause: float = 0.0
) -> dict[object, list[float]]:
    """{name: [milliseconds]} of functions that return when their work is done, called in turn,
    after one round unmeasured.

    rounds: their number; None = LEAST_ROUNDS to MOST_ROUNDS, within SECONDS. pause: seconds before
    each call, for threads of the previous one that still spin, waiting for work.
    """
    times = {name: [] for name in runs}
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
    """(relative L2 error, largest absolute difference). Raises FloatingPointError if a value is NaN
    or Inf.
    """
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    if not np.isfinite(actual).all():
        raise FloatingPointError("a result holds NaN or Inf")
    difference = actual - expected
    scale = max(np.linalg.norm(expected), np.finfo(np.float32).tiny)
    return float(np.linalg.norm(difference) / scale), float(np.abs(difference).max())


def variant_rows(
    about: dict,
    runs: dict[str, Callable],
    found: dict[str, tuple],
    *,
    flops: int,
    peak: PeakFlops,
) -> list[dict]:
    """A row for each variant, timed in turn with the peak: `about`, its time, speed and errors.

    about: keys that all rows share. runs: {variant: function}. found: {variant: (relative L2,
    largest)}. flops: floating-point operations of one run, counted as direct convolutions.
    """
    times = interleave({**runs, "peak": peak.run})
    peak_gflops = peak.flops / np.median(times["peak"]) * 1e-6
    rows = []
    for variant in runs:
        low, ms, high = np.percentile(times[variant], (25, 50, 75))
        gflops = flops / ms * 1e-6
        rows.append(
            {"variant": variant}
            | about
            | {
                "ms": float(ms),
                "ms_quartiles": [float(low), float(high)],
                "ms_range": [min(times[variant]), max(times[variant])],
                "runs": len(times[variant]),
                "gflops": float(gflops),
                "peak_gflops": float(peak_gflops),
                "peak_share": float(gflops / peak_gflops),
                "rel_l2": found[variant][0],
                "max_err": found[variant][1],
            }
        )
    return rows
