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
    """A result's error, infinite where the result is not finite, and what it may be."""

    error: float
    bound: float

    @property
    def share(self) -> float:
        """The error as a share of the bound; 0 of 0 is 0."""
        if self.error == 0:
            return 0.0
        return self.error / self.bound if self.bound else np.inf


@dataclass(frozen=True)
class Case:
    """name: "wing: what", unique. run(dev, rng) yields the checks. variant: the only one of the
    convolutions that the case is of; devices to which it is not offered leave the case out.
    """

    name: str
    run: Callable[[Device, np.random.Generator], Iterable[Check]]
    variant: str | None = None


def relative(actual: ArrayLike, expected: ArrayLike, bound: float) -> Check:
    """The largest error over the largest expected value. bound: of that."""
    return Check(_largest(actual, expected, np.abs(expected).max(initial=0)), bound)


def absolute(actual: ArrayLike, expected: ArrayLike, bound: float) -> Check:
    """The largest error. bound: of that."""
    return Check(_largest(actual, expected, 1.0), bound)


def each(actual: ArrayLike, expected: ArrayLike, bound: float, floor: float = 0.0) -> Check:
    """The largest error of a value over that value, or over `floor` more. bound: of that."""
    return Check(_largest(actual, expected, np.abs(expected) + floor), bound)


def allowed(actual: ArrayLike, expected: ArrayLike, most: np.ndarray) -> Check:
    """The largest error as a share of what it may be at that place, so that the bound is 1."""
    return Check(_largest(actual, expected, most), 1.0)


def exact(actual: ArrayLike, expected: ArrayLike) -> Check:
    """How many values differ. The bound is 0."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    _same_shape(actual, expected)
    return Check(float(np.count_nonzero(actual != expected)), 0.0)


def finite(*arrays: np.ndarray) -> Check:
    """How many values are NaN or infinite. The bound is 0."""
    return Check(float(sum(np.count_nonzero(~np.isfinite(a)) for a in arrays)), 0.0)


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
