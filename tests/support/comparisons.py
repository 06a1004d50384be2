"""Comparing results with float64 values, and gradients with finite differences."""

import numpy as np


def relative_error(actual, expected):
    """Largest absolute difference over the largest absolute expected value (both as float64)."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    assert actual.shape == expected.shape, (actual.shape, expected.shape)
    assert np.isfinite(actual).all(), "NaN or Inf in the result"
    return np.abs(actual - expected).max(initial=0) / max(np.abs(expected).max(initial=0), 1e-30)


def numeric_gradient(function, values, step, indices=None):
    """Central differences of a scalar function of a float64 array, at flat `indices` (all by
    default): (len(indices),).
    """
    values = np.array(values, np.float64)
    indices = range(values.size) if indices is None else indices
    gradient = []
    for i in indices:
        upper, lower = values.copy(), values.copy()
        upper.flat[i] += step
        lower.flat[i] -= step
        gradient.append((function(upper) - function(lower)) / (2 * step))
    return np.array(gradient)
