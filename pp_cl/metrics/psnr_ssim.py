"""PSNR, SSIM and LPIPS of 8-bit images, with the settings that published tables use."""

from typing import Any

import numpy as np
from skimage.metrics import structural_similarity

from pp_cl.engine.training.exposure import PRIOR
from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.metrics.lpips import Lpips

PSNR_CAP = 100.0  # dB, for identical images, since JSON has no infinity
SSIM_WINDOW = 11  # pixels


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """-10 log10 of the mean squared error of two uint8 images, in dB, at most PSNR_CAP."""
    mse = np.mean((a.astype(np.float64) - b) ** 2) / 255**2
    return float(min(PSNR_CAP, -10 * np.log10(max(mse, 1e-30))))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004) of two uint8 (H, W, 3) images, with an 11x11
    Gaussian window of sigma 1.5 and population variances. Raises UserError for images smaller than
    the window.
    """
    height, width = a.shape[:2]
    if min(height, width) < SSIM_WINDOW:
        raise UserError(
            f"{width}x{height} pixels, but SSIM needs {SSIM_WINDOW}x{SSIM_WINDOW}: "
            "take larger images or leave ssim out of --metrics"
        )
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    both = (a / 255.0, b / 255.0)
    return float(structural_similarity(*both, data_range=1.0, channel_axis=-1, **window))


def coloured_alike(prediction: np.ndarray, truth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """(H, W, 3) the prediction with the object's colours matched to the truth: each half of its
    pixels is transformed by the 3x4 matrix that fits the other half best. The halves alternate in
    squares of 8 pixels.

    prediction, truth: (H, W, 3) in [0, 1], over white. alpha: (H, W) of the truth.
    """
    alpha = alpha.astype(np.float64)
    white = 1 - alpha[..., None]
    y, x = np.mgrid[: alpha.shape[0], : alpha.shape[1]] // 8
    known, wanted = np.dstack([prediction - white, alpha]), truth - white
    matched, prior = np.empty_like(wanted), PRIOR * alpha.size
    for half in (0, 1):
        is_here = (x + y) % 2 == half
        a, p, t = alpha[~is_here, None], known[~is_here], wanted[~is_here]
        squares, mixed = (a * p).T @ p + prior * np.eye(4), (a * p).T @ t + prior * np.eye(4, 3)
        matched[is_here] = known[is_here] @ np.linalg.solve(squares, mixed)
    return np.clip(matched + white, 0, 1)


class Metrics:
    """Measures image pairs with the named metrics: psnr, ssim, lpips; only lpips needs dev."""

    def __init__(self, dev: Any, names: tuple[str, ...]) -> None:
        self.names = names
        self._lpips: Any = Lpips(dev) if "lpips" in names else None

    def __call__(self, prediction: np.ndarray, truth: np.ndarray) -> dict[str, float]:
        """{name: number} of two float (H, W, 3) images in [0, 1], rounded to 8 bits. Raises
        ValueError if the shapes differ, UserError if they are too small for a metric.
        """
        if prediction.shape != truth.shape:
            raise ValueError(f"prediction {prediction.shape}, truth {truth.shape}")
        a, b = to_8bit(prediction), to_8bit(truth)
        functions = {"psnr": psnr, "ssim": ssim}
        if self._lpips:
            functions["lpips"] = lambda a, b: self._lpips.distance(a / 255.0, b / 255.0)
        return {name: functions[name](a, b) for name in self.names}


def mean(rows: list[dict]) -> dict[str, float]:
    """{key: mean over the rows}, for dicts of numbers with the same keys; "name" is left out."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "name"}
