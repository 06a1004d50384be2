"""PSNR, SSIM and LPIPS of 8-bit images, with the settings behind the tables of this field."""

from typing import Any

import numpy as np
from skimage.metrics import structural_similarity

from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.metrics.lpips import Lpips

PSNR_CAP = 100.0  # dB of identical images: JSON has no infinity
SSIM_WINDOW = 11  # pixels


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """-10 log10 of the mean squared error of two uint8 images, in dB, at most PSNR_CAP."""
    mse = np.mean((a.astype(np.float64) - b) ** 2) / 255**2
    return float(min(PSNR_CAP, -10 * np.log10(max(mse, 1e-30))))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004) of two uint8 (H, W, 3) images: Gaussian window 11x11
    of sigma 1.5, population variances. Raises UserError for images smaller than the window.
    """
    height, width = a.shape[:2]
    if min(height, width) < SSIM_WINDOW:
        raise UserError(
            f"{width}x{height} pixels, SSIM needs {SSIM_WINDOW}x{SSIM_WINDOW}: "
            "take larger images or leave ssim out of --metrics"
        )
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    both = (a / 255.0, b / 255.0)
    return float(structural_similarity(*both, data_range=1.0, channel_axis=-1, **window))


def exposed_alike(truth: np.ndarray, prediction: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """(H, W, 3) the truth, its object divided by the gains that bring the prediction nearest to it.
    truth, prediction: (H, W, 3) in [0, 1], over white. alpha: (H, W) of the truth.
    """
    white = 1 - alpha[..., None].astype(np.float64)
    p, t = prediction - white, truth - white
    weighted = alpha[..., None] * p
    gains = (weighted * t).sum((0, 1)) / np.maximum((weighted * p).sum((0, 1)), 1e-12)
    return np.clip(t / np.maximum(gains, 1e-3) + white, 0, 1)


class Metrics:
    """The named metrics of image pairs. names: out of psnr, ssim, lpips; only lpips needs dev."""

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
    """{key: mean over the rows} of dicts of numbers with the same keys, but for "name"."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "name"}
