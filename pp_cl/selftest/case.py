"""A case of the selftest, and functions that measure the error of its results."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pp_cl.engine.device.device import Device

EPS = 2.0**-23  # float32's distance from 1 to the next number; a rounding error is at most half
SIZES = (1, 31, 33, 257)  # below, at and above every vector width and work-group size


class Check(NamedTuple):
    """A result's error, infinite if the result is not finite, and its bound. naive: the error of a
    naive formula for the same result, NaN if its result is NaN; None: there is no such formula.
    """

    error: float
    bound: float
    naive: float | None = None

    @property
    def share(self) -> float:
        """The error as a share of the bound; an error of 0 gives 0."""
        return _share(self.error, self.bound)

    @property
    def naive_share(self) -> float:
        """The share for the naive formula: infinite for NaN, -1 if there is no such formula."""
        if self.naive is None:
            return -1.0
        return np.inf if np.isnan(self.naive) else _share(self.naive, self.bound)


@dataclass(frozen=True)
class Case:
    """name: "wing: subject", unique. run(dev, rng) yields the checks. variant: the convolution that
    the case tests; devices to which it is not offered skip the case. hard: how the naive formula
    fails in a hard case; the formula is computed in float32, and a check compares with it.
    """

    name: str
    run: Callable[[Device, np.random.Generator], Iterable[Check]]
    variant: str | None = None
    hard: str = ""


Naive = np.ndarray | None  # the result of a naive formula


def relative(actual: ArrayLike, expected: ArrayLike, bound: float, *, naive: Naive = None) -> Check:
    """A check of the largest error divided by the largest expected value."""
    return _check(actual, expected, np.abs(expected).max(initial=0), bound, naive)


def absolute(actual: ArrayLike, expected: ArrayLike, bound: float, *, naive: Naive = None) -> Check:
    """A check of the largest error."""
    return _check(actual, expected, 1.0, bound, naive)


def each(
    actual: ArrayLike,
    expected: ArrayLike,
    bound: float,
    floor: float = 0.0,
    *,
    naive: Naive = None,
) -> Check:
    """A check of the largest error of a value divided by the expected value plus `floor`."""
    return _check(actual, expected, np.abs(expected) + floor, bound, naive)


def allowed(
    actual: ArrayLike, expected: ArrayLike, most: np.ndarray, *, naive: Naive = None
) -> Check:
    """A check of the largest error as a share of its bound `most` at each place, so of bound 1."""
    return _check(actual, expected, most, 1.0, naive)


def exact(actual: ArrayLike, expected: ArrayLike, *, naive: Naive = None) -> Check:
    """A check that no value differs; the error is the number of those that do."""
    return Check(_differing(actual, expected), 0.0, _of_naive(_differing, naive, expected))


def finite(*arrays: np.ndarray, naive: Naive = None) -> Check:
    """A check that no value is NaN or infinite; the error is the number of those that are."""
    return Check(_not_finite(arrays), 0.0, _of_naive(_not_finite, naive))


def _check(actual, expected, scale, bound, naive):
    error = _largest(actual, expected, scale)
    return Check(error, bound, _of_naive(_largest, naive, expected, scale))


def _of_naive(measure, naive, *others):
    """The naive formula's error, or NaN. Raises ValueError if it was computed in float64."""
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
    """The largest error divided by the scale at its place; infinite if a result is not finite."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    _same_shape(actual, expected)
    with np.errstate(all="ignore"):
        error = np.abs(actual - expected)
        error = np.where(np.isfinite(error), error, np.inf)
        shares = np.where(error > 0, error / scale, 0.0)
        return float(np.where(np.isnan(shares), np.inf, shares).max(initial=0))


def _same_shape(actual, expected):
    if actual.shape != expected.shape:
        raise ValueError(f"the result has the shape {actual.shape}, not {expected.shape}")
