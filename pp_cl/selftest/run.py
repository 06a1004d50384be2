"""Runs the cases of the selftest one by one."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pp_cl.device.device import Device
from pp_cl.layers.choice import device_class, offered
from pp_cl.selftest import blend, device, layers, metrics, raster, scene, training
from pp_cl.selftest.case import Case

SEED = 7
CASES: tuple[Case, ...] = (
    *device.CASES,
    *scene.CASES,
    *raster.CASES,
    *blend.CASES,
    *layers.CASES,
    *training.CASES,
    *metrics.CASES,
)


@dataclass(frozen=True)
class Row:
    """What a case found.

    error, bound: of the check that came closest to its bound, or exceeded it most; None where the
    case ended with an exception. reason: of a failure that numbers do not say, one line, else "".
    """

    case: str
    error: float | None
    bound: float | None
    passed: bool
    reason: str
    seconds: float


def run_cases(dev: Device, cases: Iterable[Case]) -> Iterator[Row]:
    """The row of each case, as soon as it is there; those of variants that are not offered to the
    device are left out. An exception fails its case, whatever it is.
    """
    variants = (None, *offered(device_class(dev)))
    for case in cases:
        if case.variant in variants:
            yield run_case(dev, case)


def run_case(dev: Device, case: Case) -> Row:
    """The row of one case."""
    start = time.perf_counter()
    try:
        with np.errstate(all="ignore"):  # what is not finite is a result here
            checks = case.run(dev, np.random.default_rng(SEED))
            worst = max(checks, key=lambda check: check.share)
    except Exception as error:
        words = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        return Row(case.name, None, None, False, words, time.perf_counter() - start)
    error, bound = float(worst.error), float(worst.bound)
    reason = "" if np.isfinite(error) else "NaN, Inf or a value where there may be none"
    seconds = time.perf_counter() - start
    return Row(case.name, error, bound, error <= bound, reason, seconds)
