"""Float64 twins of what changes parameters: Adam as torch computes it, the SH gradient written out,
grid smoothing.
"""

from typing import Any

import numpy as np

from pp_cl.reference.raster import sh_basis


class Adam:
    """torch.optim.Adam without weight decay, for one array; lazy where a step lists rows."""

    def __init__(self, parameter: np.ndarray, beta1: float = 0.9, beta2: float = 0.999):
        self.parameter = np.array(parameter, np.float64)
        self.m, self.v, self.t = np.zeros_like(self.parameter), np.zeros_like(self.parameter), 0
        self.last_step = np.zeros(len(self.parameter), int)
        self.betas = beta1, beta2

    def step(
        self,
        grad: np.ndarray,
        rate: float,
        eps: float,
        *,
        low: float = -np.inf,
        high: float = np.inf,
        rows: Any = slice(None),
    ) -> None:
        """rows: those that this step updates. The steps since their last one are applied first,
        with gradients of 0: the moments exactly, the moves with the present rate and eps.
        """
        beta1, beta2 = self.betas
        self.t += 1
        moved = self.parameter[rows] + self.pending(self.t, rate, eps, rows)
        skipped = self._skipped(self.t, rows)
        self.last_step[rows] = self.t
        c1, c2 = 1 - beta1**self.t, 1 - beta2**self.t
        grad = np.asarray(grad, np.float64)[rows]
        m = beta1 * beta1**skipped * self.m[rows] + (1 - beta1) * grad
        v = beta2 * beta2**skipped * self.v[rows] + (1 - beta2) * grad * grad
        moved -= rate / c1 * m / (np.sqrt(v / c2) + eps)
        self.m[rows], self.v[rows], self.parameter[rows] = m, v, np.clip(moved, low, high)

    def go_to(self, t: int) -> None:
        """Count t steps."""
        self.t = t

    def pending(self, t: int, rate: float, eps: float, rows: Any = slice(None)) -> np.ndarray:
        """What the steps that the rows skipped before step t have yet to move them by."""
        beta1, beta2 = self.betas
        skipped, m, v = self._skipped(t, rows), self.m[rows], self.v[rows]
        c1, c2, moves = 1 - beta1**t, 1 - beta2**t, np.zeros_like(m)
        for j in range(1, skipped.max(initial=0) + 1):
            with_decay = rate / c1 * m * beta1**j / (np.sqrt(v / c2) + eps) / np.sqrt(beta2) ** j
            moves -= np.where(j <= skipped, with_decay, 0)
            if beta1**j < 1e-30:
                break
        return moves

    def _skipped(self, t, rows):
        shape = (-1, *[1] * (self.parameter.ndim - 1))
        return (t - 1 - self.last_step[rows]).reshape(shape)


def block_basis(positions: np.ndarray, eye: np.ndarray, block: Any) -> np.ndarray:
    """(N, block.count): the harmonics of one sh.ShBlock in the directions from the eye."""
    towards = positions - eye
    basis = sh_basis(towards / np.linalg.norm(towards, axis=-1, keepdims=True))
    return basis[:, block.first : block.first + block.count]


def sh_gradient(
    positions: np.ndarray, eye: np.ndarray, grad_point_features: np.ndarray, block: Any
) -> np.ndarray:
    """(N, block.count, 16) gradient of the SH coefficients of one sh.ShBlock."""
    gradient = np.asarray(grad_point_features, np.float64)
    return block_basis(positions, eye, block)[:, :, None] * gradient[:, None, :]


def neighbours(ids: np.ndarray, dims: tuple[int, int, int]) -> list[list[int | None]]:
    """Per point the indices of its neighbours -x, +x, -y, +y, -z, +z, None where there is none."""
    nx, ny, _ = dims
    index = {(int(i) % nx, int(i) // nx % ny, int(i) // (nx * ny)): n for n, i in enumerate(ids)}
    offsets = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]
    return [[index.get((x + a, y + b, z + c)) for a, b, c in offsets] for x, y, z in index]


def smoothed(
    values: np.ndarray, ids: np.ndarray, dims: tuple[int, int, int], amount: float
) -> np.ndarray:
    """Array (N, ...) moved by `amount` towards the mean of their neighbours."""
    old = np.asarray(values, np.float64)
    new = old.copy()
    for i, around in enumerate(neighbours(ids, dims)):
        around = [j for j in around if j is not None]
        if around:
            new[i] += amount * (old[around].mean(axis=0) - old[i])
    return new
