"""Winograd's minimal filtering F(m x m, 3 x 3) in float64 numpy, with transformed weights that may
have been rounded.
"""

import numpy as np

POINTS = {2: (0, 1, -1), 4: (0, 3 / 4, -3 / 4, 3 / 2, -3 / 2)}  # and infinity
ROUNDING = 2.0**-11  # half's largest relative error: 11 bits
SMALLEST = 2.0**-24  # half's smallest positive number


def matrices(m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A (S, m), G (S, 3), B (S, S)) with y = A^T [(G g) o (B d)] for S = m + 2 samples d and a
    kernel g of 3.
    """
    points = np.array(POINTS[m])
    distances = np.array([np.prod(p - np.delete(points, i)) for i, p in enumerate(points)])
    if m == 2:
        distances[0] *= -1  # Lavin and Gray's sign; that of a row of G and of B is free
    a, g = np.eye(m)[[m - 1] * (m + 2)], np.eye(3)[[2] * (m + 2)]  # rows of infinity
    a[:-1] = points[:, None] ** np.arange(m)
    g[:-1] = points[:, None] ** np.arange(3) / distances[:, None]
    # B is what makes y[j] the sum of g[k] d[j + k]: one column for each sample
    products = np.einsum("sj,sk->jks", a, g).reshape(3 * m, m + 2)
    wanted = np.equal.outer(np.add.outer(np.arange(m), np.arange(3)).ravel(), np.arange(m + 2))
    return a, g, np.linalg.lstsq(products, wanted.astype(np.float64), rcond=None)[0]


def transform_weights(m: int, weight: np.ndarray, magnitude: bool = False) -> np.ndarray:
    """weight (CO, CI, 3, 3) -> (S, S, CO, CI). magnitude: the sums of the terms' absolute
    values.
    """
    g = matrices(m)[1]
    g, weight = (np.abs(g), np.abs(weight)) if magnitude else (g, weight)
    return np.einsum("sk,tl,oikl->stoi", g, g, np.asarray(weight, np.float64), optimize=True)


def convolve(m: int, x: np.ndarray, transformed: np.ndarray, magnitude: bool = False) -> np.ndarray:
    """x (H, W, CI), transformed (S, S, CO, CI) -> (H, W, CO).

    magnitude: the sums of the absolute values of what each transformed weight adds to an output.
    """
    a, _, b = matrices(m)
    height, width, _ = x.shape
    rows, columns = -(-height // m), -(-width // m)
    padded = np.pad(
        np.asarray(x, np.float64),
        ((1, rows * m + 1 - height), (1, columns * m + 1 - width), (0, 0)),
    )
    # (rows, columns, CI, S, S)
    tiles = np.lib.stride_tricks.sliding_window_view(padded, (m + 2, m + 2), (0, 1))[::m, ::m]
    values = np.einsum("su,tv,yxiuv->styxi", b, b, tiles, optimize=True)
    if magnitude:
        a, values, transformed = np.abs(a), np.abs(values), np.abs(transformed)
    products = np.einsum("styxi,stoi->styxo", values, transformed, optimize=True)
    out = np.einsum("sj,tk,styxo->yjxko", a, a, products, optimize=True)
    return out.reshape(rows * m, columns * m, -1)[:height, :width]


def rounding_bound(m: int, x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(H, W, CO): at most so much of a convolution's outputs may change when the transformed
    weights are rounded to half.
    """
    return ROUNDING * convolve(m, x, transform_weights(m, weight), magnitude=True)


def rounding_share(m: int) -> float:
    """ROUNDING times how much more than the outputs, in L2, all products with transformed weights
    are, on white noise.
    """
    a, g, b = matrices(m)
    # variances: of each output along one axis; exactly computed, 1
    along = a.T**2 @ ((g**2).sum(1) * (b**2).sum(1)) / 3
    return ROUNDING * along.mean()
