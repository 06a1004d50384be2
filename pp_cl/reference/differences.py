"""Gradients by finite differences."""

from collections.abc import Callable, Iterable

import numpy as np


def numeric_gradient(
    function: Callable[[np.ndarray], float],
    values: np.ndarray,
    step: float,
    indices: Iterable[int] | None = None,
) -> np.ndarray:
    """(len(indices),) central differences of a function of an array at flat indices; None: all."""
    values = np.array(values, np.float64)
    indices = range(values.size) if indices is None else indices
    gradient = []
    for i in indices:
        upper, lower = values.copy(), values.copy()
        upper.flat[i] += step
        lower.flat[i] -= step
        gradient.append((function(upper) - function(lower)) / (2 * step))
    return np.array(gradient)
