"""The transfer function of sRGB and its inverse (IEC 61966-2-1)."""

import numpy as np


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1's transfer function: [0, 1] to linear light."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


def linear_to_srgb(values: np.ndarray) -> np.ndarray:
    """The inverse of srgb_to_linear(): linear light in [0, 1] to sRGB."""
    low = values <= 0.0031308
    return np.where(low, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055).astype(np.float32)
