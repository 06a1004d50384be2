"""Float64 twin of cl/training/loss.cl: the textbook SSIM with 2-D windows, and gradients derived
from that form; and of cl/training/depth_loss.cl.
"""

import numpy as np
from numpy.typing import DTypeLike

C1, C2 = 0.01**2, 0.03**2


def _window():
    x = np.arange(-5, 6)
    g = np.exp(-x * x / (2 * 1.5**2))
    return np.outer(g, g) / g.sum() ** 2


WINDOW = _window()


def windowed(image: np.ndarray) -> np.ndarray:
    """(H-10, W-10, 3) weighted mean of each 11x11 window of an (H, W, 3) image, in its dtype."""
    (h, w, _), window = image.shape, WINDOW.astype(image.dtype)
    return sum(
        window[j, i] * image[j : h - 10 + j, i : w - 10 + i] for j in range(11) for i in range(11)
    )


def unwindowed(derivatives: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """The adjoint of windowed."""
    (h, w, _), window = shape, WINDOW.astype(derivatives.dtype)
    image = np.zeros(shape, derivatives.dtype)
    for j in range(11):
        for i in range(11):
            image[j : h - 10 + j, i : w - 10 + i] += window[j, i] * derivatives
    return image


def ssim(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """(mean SSIM, its gradient with respect to x)."""
    mx, my = windowed(x), windowed(y)
    vx, vy, cov = windowed(x * x) - mx**2, windowed(y * y) - my**2, windowed(x * y) - mx * my
    a1, a2, b1, b2 = 2 * mx * my + C1, 2 * cov + C2, mx**2 + my**2 + C1, vx + vy + C2
    similarity = a1 * a2 / (b1 * b2)
    d_mx = 2 * my * a2 / (b1 * b2) - 2 * mx * similarity / b1
    d_vx = -similarity / b2
    d_cov = 2 * a1 / (b1 * b2)
    gradient = (
        unwindowed(d_mx - 2 * mx * d_vx - my * d_cov, x.shape)
        + 2 * x * unwindowed(d_vx, x.shape)
        + y * unwindowed(d_cov, x.shape)
    )
    return similarity.mean(), gradient / similarity.size


def loss(
    prediction: np.ndarray,
    target: np.ndarray,
    weight: float,
    beta: float = 0.0,
    dtype: DTypeLike = np.float64,
) -> tuple[np.ndarray, np.ndarray]:
    """(terms (4,): L, L1, 1 - SSIM, mean squared error; gradient (H, W, 3)) of equally large
    images. dtype: float32 shows what the textbook's form loses.
    """
    x, y = np.asarray(prediction, dtype), np.asarray(target, dtype)
    error = np.abs(x - y)
    smooth, gradient = error.mean(), np.sign(x - y) / x.size
    if beta:
        smooth = np.where(error < beta, error**2 / (2 * beta), error - beta / 2).mean()
        gradient *= np.minimum(error / beta, 1)
    dissimilarity = 0.0
    if weight and min(x.shape[:2]) >= 11:
        similarity, d_x = ssim(x, y)
        dissimilarity = 1 - similarity
        gradient = gradient - weight * d_x
    terms = smooth + weight * dissimilarity, error.mean(), dissimilarity, (error**2).mean()
    return np.array(terms, dtype), gradient


def bending(depth: np.ndarray, has_surface: np.ndarray) -> tuple[float, np.ndarray]:
    """(depth loss, its gradient (H, W)) of depths (H, W) in voxels. has_surface: (H, W) bool."""
    gradient, total = np.zeros(depth.shape), 0.0
    for axis in (0, 1):
        z, sums = (np.moveaxis(a, axis, 0) for a in (depth, gradient))
        where = np.moveaxis(has_surface, axis, 0)
        for s in (1, 2, 4):
            if len(z) <= 2 * s:
                continue
            ends = np.s_[: -2 * s], np.s_[s:-s], np.s_[2 * s :]
            counts = where[ends[0]] & where[ends[1]] & where[ends[2]]
            c = np.where(counts, z[ends[0]] - 2 * z[ends[1]] + z[ends[2]], 0)
            total += (c**2 / (1 + c**2 / 4)).sum()
            for part, times in zip(ends, (1, -2, 1), strict=True):
                sums[part] += times * 2 * c / (1 + c**2 / 4) ** 2
    return total / depth.size, gradient / depth.size
