"""A case of the selftest, and how the error of its results is measured."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pp_cl.engine.device.device import Device

EPS = 2.0**-23  # float32's distance from 1 to the next number; a rounding is half of it at most
SIZES = (1, 31, 33, 257)  # below, at and beside every vector width and work-group size


class Check(NamedTuple):
    """A result's error, infinite where the result is not finite, and what it may be. naive: the
    error of a naive formula for the same result, NaN where that is one; None: there is none.
    """

    error: float
    bound: float
    naive: float | None = None

    @property
    def share(self) -> float:
        """The error as a share of the bound; 0 of 0 is 0."""
        return _share(self.error, self.bound)

    @property
    def naive_share(self) -> float:
        """The same of the naive formula; infinite for NaN, below 0 where there is none."""
        if self.naive is None:
            return -1.0
        return np.inf if np.isnan(self.naive) else _share(self.naive, self.bound)


@dataclass(frozen=True)
class Case:
    """name: "wing: what", unique. run(dev, rng) yields the checks. variant: the only one of the
    convolutions that the case is of; devices to which it is not offered leave the case out. hard:
    of a hard case, what the naive formula does, computed in float32, that a check compares with.
    """

    name: str
    run: Callable[[Device, np.random.Generator], Iterable[Check]]
    variant: str | None = None
    hard: str = ""


Naive = np.ndarray | None  # what a naive formula gives in place of the actual result


def relative(actual: ArrayLike, expected: ArrayLike, bound: float, *, naive: Naive = None) -> Check:
    """The largest error over the largest expected value. bound: of that."""
    return _check(actual, expected, np.abs(expected).max(initial=0), bound, naive)


def absolute(actual: ArrayLike, expected: ArrayLike, bound: float, *, naive: Naive = None) -> Check:
    """The largest error. bound: of that."""
    return _check(actual, expected, 1.0, bound, naive)


def each(
    actual: ArrayLike,
    expected: ArrayLike,
    bound: float,
    floor: float = 0.0,
    *,
    naive: Naive = None,
) -> Check:
    """The largest error of a value over that value, or over `floor` more. bound: of that."""
    return _check(actual, expected, np.abs(expected) + floor, bound, naive)


def allowed(
    actual: ArrayLike, expected: ArrayLike, most: np.ndarray, *, naive: Naive = None
) -> Check:
    """The largest error as a share of what it may be at that place, so that the bound is 1."""
    return _check(actual, expected, most, 1.0, naive)


def exact(actual: ArrayLike, expected: ArrayLike, *, naive: Naive = None) -> Check:
    """How many values differ. The bound is 0."""
    return Check(_differing(actual, expected), 0.0, _of_naive(_differing, naive, expected))


def finite(*arrays: np.ndarray, naive: Naive = None) -> Check:
    """How many values are NaN or infinite. The bound is 0."""
    return Check(_not_finite(arrays), 0.0, _of_naive(_not_finite, naive))


def _check(actual, expected, scale, bound, naive):
    error = _largest(actual, expected, scale)
    return Check(error, bound, _of_naive(_largest, naive, expected, scale))


def _of_naive(measure, naive, *others):
    """Its error; NaN where it is one. Raises ValueError where it was computed in float64."""
    if naive is None:
        return None
    if naive.dtype == np.float64:
        raise ValueError("the naive formula was computed in float64")
    return np.nan if np.isnan(naive).any() else measure(naive, *others)


def _share(error, bound):
    if error == 0:
        return 0.0
    return error / bound if bound else np.inf


def _differing(actual, expected):
    actual, expected = np.asarray(actual), np.asarray(expected)
    _same_shape(actual, expected)
    return float(np.count_nonzero(actual != expected))


def _not_finite(arrays):
    return float(sum(np.count_nonzero(~np.isfinite(a)) for a in arrays))


def _largest(actual, expected, scale):
    """The largest error over the scale at its place; infinite for what is not finite."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    _same_shape(actual, expected)
    with np.errstate(all="ignore"):
        error = np.abs(actual - expected)
        error = np.where(np.isfinite(error), error, np.inf)
        return float(np.where(error > 0, error / scale, 0.0).max(initial=0))


def _same_shape(actual, expected):
    if actual.shape != expected.shape:
        raise ValueError(f"the result has the shape {actual.shape}, not {expected.shape}")
