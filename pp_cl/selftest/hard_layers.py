"""3x3 convolutions whose inputs or weights are made to hurt float32, Winograd's transforms or
half's range.
"""

import numpy as np


def hard_layers(rng: np.random.Generator) -> dict[str, tuple[np.ndarray, ...]]:
    """{name: (x (H, W, CI), weight (CO, CI, 3, 3), bias (CO,), grad_out (H, W, CO))}, float32."""

    def normal(*shape):
        return rng.normal(size=shape).astype(np.float32)

    def layer(x, weight, bias=None, grad_out=None):
        weight = np.asarray(weight, np.float32)
        bias = normal(len(weight)) if bias is None else bias
        grad_out = normal(*x.shape[:2], len(weight)) if grad_out is None else grad_out
        return x.astype(np.float32), weight, bias, grad_out

    x, weight = normal(13, 17, 32), normal(32, 32, 3, 3) / np.sqrt(np.float32(288))
    decades = 10 ** rng.uniform(-3, 3, 32)
    bright = np.zeros_like(x)
    bright[6, 8] = 1e3 * x[6, 8]
    # half's largest number is 65504, its smallest 6e-8
    limits = np.where(np.arange(32) % 2, 6e4, 1e-7)
    none = np.zeros_like
    return {
        "means of 1e3": layer(1e3 + x, weight),
        "means of 1e3, weights that sum to zero": layer(
            1e3 + x, weight - weight.mean((2, 3), keepdims=True)
        ),
        "weights over six decades, by output channel": layer(
            x, weight * decades[:, None, None, None]
        ),
        "weights over six decades, by input channel": layer(x, weight * decades[:, None, None]),
        "weights over six decades, one by one": layer(
            x, weight * 10 ** rng.uniform(-3, 3, weight.shape)
        ),
        "512 channels": layer(normal(12, 12, 512), normal(512, 512, 3, 3) / np.sqrt(4608)),
        "background with one bright pixel": layer(bright, weight, none(weight[:, 0, 0, 0])),
        "background alone": layer(none(x), weight, grad_out=none(x)),
        "weights of 6e4": layer(x, 6e4 * np.sign(weight)),
        "weights of 1e-7": layer(x, 1e-7 * np.sign(weight), none(weight[:, 0, 0, 0])),
        "output channels of 6e4 and of 1e-7": layer(x, weight * limits[:, None, None, None]),
        "inputs and gradients of 6e4": layer(
            6e4 * np.sign(x), weight, grad_out=6e4 * np.sign(normal(*x.shape))
        ),
        "inputs and gradients of 1e-7": layer(
            1e-7 * x, weight, none(weight[:, 0, 0, 0]), 1e-7 * normal(*x.shape)
        ),
    }
