"""Float64 twins of cl/layers/conv.cl and cl/layers/conv_backward_weights.cl, in the plain (CO, CI,
K, K) layout of weights.
"""

import numpy as np


def _shifted(x, k):
    """Yields (ky, kx, x seen through that tap): x[y + ky - k//2, x + kx - k//2], zero outside."""
    height, width, _ = x.shape
    padded = np.pad(np.asarray(x, np.float64), ((k // 2, k // 2), (k // 2, k // 2), (0, 0)))
    for ky in range(k):
        for kx in range(k):
            yield ky, kx, padded[ky : ky + height, kx : kx + width]


def conv(x, weight, bias, relu=False):
    """x (H, W, CI), weight (CO, CI, K, K), bias (CO,) -> (H, W, CO)."""
    out = np.broadcast_to(np.asarray(bias, np.float64), (*x.shape[:2], len(bias))).copy()
    for ky, kx, seen in _shifted(x, weight.shape[2]):
        out += seen @ np.asarray(weight[:, :, ky, kx], np.float64).T
    return np.maximum(out, 0) if relu else out


def conv_gradients(x, weight, grad_out):
    """(grad_x, grad_weight, grad_bias) of conv without ReLU."""
    grad_out = np.asarray(grad_out, np.float64)
    k, height, width = weight.shape[2], *x.shape[:2]
    grad_weight = np.zeros(weight.shape)
    grad_padded = np.zeros((height + k - 1, width + k - 1, x.shape[2]))
    for ky, kx, seen in _shifted(x, k):
        grad_weight[:, :, ky, kx] = np.einsum("yxo,yxi->oi", grad_out, seen, optimize=True)
        grad_padded[ky : ky + height, kx : kx + width] += grad_out @ np.asarray(
            weight[:, :, ky, kx], np.float64
        )
    grad_x = grad_padded[k // 2 : k // 2 + height, k // 2 : k // 2 + width]
    return grad_x, grad_weight, grad_out.sum((0, 1))
