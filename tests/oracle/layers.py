"""Float64 twins of cl/layers/resample.cl and cl/layers/gate.cl."""

import numpy as np
from scipy.special import expit


def avgpool2(x):
    """(2H, 2W, C) -> (H, W, C)."""
    h, w, c = x.shape
    return np.asarray(x, np.float64).reshape(h // 2, 2, w // 2, 2, c).mean((1, 3))


def avgpool2_gradient(grad_out):
    """(H, W, C) -> (2H, 2W, C)."""
    return 0.25 * np.asarray(grad_out, np.float64).repeat(2, 0).repeat(2, 1)


def gate(x):
    """(H, W, 2 C) -> (H, W, C): ELU of the first half of the channels, sigmoid of the second."""
    features, gates = np.split(np.asarray(x, np.float64), 2, 2)
    return np.where(features > 0, features, np.expm1(np.minimum(features, 0))) * expit(gates)


def gate_gradient(x, grad_out):
    """(H, W, 2 C), (H, W, C) -> (H, W, 2 C)."""
    features, gates = np.split(np.asarray(x, np.float64), 2, 2)
    slope = np.where(features > 0, 1, np.exp(np.minimum(features, 0)))
    opened = expit(gates) * expit(-gates)  # the derivative of the sigmoid
    value = np.where(features > 0, features, np.expm1(np.minimum(features, 0)))
    return np.concatenate([grad_out * slope * expit(gates), grad_out * value * opened], 2)


def upsample_matrix(n):
    """(2n, n): row i holds the weights of output i, from the definition by coordinates (i + 0.5) /
    2 - 0.5.
    """
    matrix = np.zeros((2 * n, n))
    for i in range(2 * n):
        position = min(max((i + 0.5) / 2 - 0.5, 0), n - 1)
        low = int(position)
        high = min(low + 1, n - 1)
        matrix[i, low] += 1 - (position - low)
        matrix[i, high] += position - low
    return matrix


def upsample2(x):
    """(H, W, C) -> (2H, 2W, C)."""
    return np.einsum(
        "Yy,Xx,yxc->YXc",
        upsample_matrix(x.shape[0]),
        upsample_matrix(x.shape[1]),
        np.asarray(x, np.float64),
        optimize=True,
    )


def upsample2_gradient(grad_out):
    """(2H, 2W, C) -> (H, W, C)."""
    rows, columns = upsample_matrix(grad_out.shape[0] // 2), upsample_matrix(grad_out.shape[1] // 2)
    return np.einsum(
        "Yy,Xx,YXc->yxc", rows, columns, np.asarray(grad_out, np.float64), optimize=True
    )
