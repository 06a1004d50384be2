"""Comparing results with float64 values."""

import numpy as np


def relative_error(actual, expected):
    """Largest absolute difference over the largest absolute expected value (both as float64)."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    assert actual.shape == expected.shape, (actual.shape, expected.shape)
    assert np.isfinite(actual).all(), "NaN or Inf in the result"
    return np.abs(actual - expected).max(initial=0) / max(np.abs(expected).max(initial=0), 1e-30)
