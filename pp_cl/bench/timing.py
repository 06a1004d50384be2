"""Times of runs in turn, rows of what was timed, errors against float64, and what the device can do
at most: multiply-adds that never leave the registers, copies far larger than any cache.

Times are wall clock, launches included: every run once a round, so that a machine that slows down
slows all of them.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pp_cl.device.device import Device
from pp_cl.layers.choice import device_class
from pp_cl.layers.tiles import VECTOR

# Rounds of a measurement: at least LEAST_ROUNDS, then until SECONDS are over or MOST_ROUNDS done.
LEAST_ROUNDS, MOST_ROUNDS, SECONDS = 5, 50, 1.5

# Of one run of PeakFlops: long against the 30 us of a launch, short enough to run between any two
# others.
PEAK_SECONDS = 0.02

# Eight times what the caches of processors and GPUs hold: a copy inside a cache would be too fast.
COPY_BYTES = 2**28


def interleave(
    runs: dict[Any, Callable], rounds: int | None = None, pause: float = 0.0
) -> dict[Any, list[float]]:
    """{name: [milliseconds]} of functions that return when their work is done, called in turn,
    after one round unmeasured.

    rounds: their number; None = LEAST_ROUNDS to MOST_ROUNDS, within SECONDS. pause: seconds before
    each call, for threads of the previous one that still spin, waiting for work.
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
    """(relative L2 error, largest absolute difference). Raises FloatingPointError if a value is NaN
    or Inf.
    """
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    if not np.isfinite(actual).all():
        raise FloatingPointError("a result holds NaN or Inf")
    difference = actual - expected
    scale = max(np.linalg.norm(expected), np.finfo(np.float32).tiny)
    return float(np.linalg.norm(difference) / scale), float(np.abs(difference).max())


# Independent sums of 16 lanes, of which the fastest number is taken. A CPU core needs 2 units x 4
# cycles of registers under way and has 32 of 16 floats (16 chains), 16 of 8 (6), or 16 of 4 (3).
# More are kept in memory; the width that a driver states is not always that of its code.
# On a GPU the 16 lanes of one chain are 16 chains already, and many work-items share a unit.
CHAINS = {"CPU": (3, 6, 16), "GPU": (2,)}


class PeakFlops:
    """A loop of multiply-adds in registers, long enough to be timed. flops: floating-point
    operations of one run().
    """

    def __init__(self, dev: Device):
        self.dev = dev
        kind = device_class(dev)
        per_unit, self.local = {"CPU": (64, 1), "GPU": (2048, 64)}[kind]
        self.out = dev.empty((per_unit * dev.info["compute_units"], VECTOR))
        self.chains = max(CHAINS[kind], key=self._rate)
        self._rate(self.chains)  # its rounds

    @property
    def flops(self) -> int:
        """A multiply-add counts as two."""
        return 2 * self.out.size * self.chains * self.rounds

    def run(self, first: float = 0.0, factor: float = 0.5, term: float = 1.0) -> None:
        """Run the loop and wait for it. The chains tend to term / (1 - factor): they neither
        overflow nor vanish.
        """
        self.dev.program("bench/peak", CHAINS=self.chains).launch(
            "peak",
            len(self.out),
            local=self.local,
            n=len(self.out),
            rounds=self.rounds,
            first=first,
            factor=factor,
            term=term,
            out=self.out,
        )
        self.dev.finish()

    def _rate(self, chains):
        """Operations a second of so many chains, the best of five runs of PEAK_SECONDS or more."""
        self.chains, self.rounds = chains, 64
        self.run()  # builds the kernel
        while self._seconds() < PEAK_SECONDS:
            self.rounds *= 2
        return self.flops / min(self._seconds() for _ in range(5))

    def _seconds(self):
        start = time.perf_counter()
        self.run()
        return time.perf_counter() - start


class CopyBandwidth:
    """A copy of COPY_BYTES. bytes: moved by one run(), read and written."""

    def __init__(self, dev: Device):
        self.dev = dev
        self.source = dev.zeros((COPY_BYTES // (4 * VECTOR), VECTOR))
        self.target = dev.zeros(self.source.shape)
        self.bytes = self.source.nbytes + self.target.nbytes

    def run(self) -> None:
        """Copy and wait for it."""
        self.dev.program("bench/peak").launch(
            "peak_copy",
            len(self.source),
            n=len(self.source),
            source=self.source,
            target=self.target,
        )
        self.dev.finish()


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
        ms = np.median(times[variant])
        gflops = flops / ms * 1e-6
        rows.append(
            {"variant": variant}
            | about
            | {
                "ms": float(ms),
                "ms_range": [min(times[variant]), max(times[variant])],
                "gflops": float(gflops),
                "peak_gflops": float(peak_gflops),
                "peak_share": float(gflops / peak_gflops),
                "rel_l2": found[variant][0],
                "max_err": found[variant][1],
            }
        )
    return rows


COLUMNS = "{:8} {:26} {:9} {:14} {:>9} {:>8} {:>5} {:>8} {:>8}".format
HEAD = COLUMNS("layer", "shape", "direction", "variant", "ms", "GFLOP/s", "peak", "rel. L2", "max")


def line(row: dict) -> str:
    """A line of the printed table, of one of variant_rows()."""
    return COLUMNS(
        row["layer"],
        "x".join(map(str, row["shape"])),
        row["direction"],
        row["variant"],
        f"{row['ms']:.3f}",
        f"{row['gflops']:.1f}",
        f"{row['peak_share']:.0%}",
        f"{row['rel_l2']:.1e}",
        f"{row['max_err']:.1e}",
    )
