"""Float64 twins of what changes parameters: Adam as torch computes it, the SH gradient written out,
grid smoothing.
"""

import numpy as np


class Adam:
    """torch.optim.Adam without weight decay, for one array; lazy where a step lists rows."""

    def __init__(self, parameter, beta1=0.9, beta2=0.999):
        self.parameter = np.array(parameter, np.float64)
        self.m, self.v, self.t = np.zeros_like(self.parameter), np.zeros_like(self.parameter), 0
        self.last_step = np.zeros(len(self.parameter), int)
        self.betas = beta1, beta2

    def step(self, grad, rate, eps, low=-np.inf, high=np.inf, rows=slice(None)):
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

    def pending(self, t, rate, eps, rows=slice(None)):
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


def sh_basis(direction):
    """(9, ...) PlenOctrees' real basis at unit directions (..., 3)."""
    x, y, z = np.moveaxis(direction, -1, 0)
    pi = np.pi
    return np.stack(
        [
            0 * x + np.sqrt(1 / (4 * pi)),
            -np.sqrt(3 / (4 * pi)) * y,
            np.sqrt(3 / (4 * pi)) * z,
            -np.sqrt(3 / (4 * pi)) * x,
            np.sqrt(15 / (4 * pi)) * x * y,
            -np.sqrt(15 / (4 * pi)) * y * z,
            np.sqrt(5 / (16 * pi)) * (3 * z * z - 1),
            -np.sqrt(15 / (4 * pi)) * x * z,
            np.sqrt(15 / (16 * pi)) * (x * x - y * y),
        ]
    )


def block_basis(positions, eye, block):
    """(N, block.count): the harmonics of one sh.ShBlock in the directions from the eye."""
    towards = positions - eye
    basis = sh_basis(towards / np.linalg.norm(towards, axis=-1, keepdims=True))
    return basis[block.first : block.first + block.count].T


def sh_gradient(positions, eye, grad_point_features, block):
    """(N, block.count, 16) gradient of the SH coefficients of one sh.ShBlock."""
    gradient = np.asarray(grad_point_features, np.float64)
    return block_basis(positions, eye, block)[:, :, None] * gradient[:, None, :]


def neighbours(ids, dims):
    """Per point the indices of its neighbours -x, +x, -y, +y, -z, +z, None where there is none."""
    nx, ny, nz = dims
    index = {(int(i) % nx, int(i) // nx % ny, int(i) // (nx * ny)): n for n, i in enumerate(ids)}
    assert all(z < nz for _, _, z in index)
    offsets = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]
    return [[index.get((x + a, y + b, z + c)) for a, b, c in offsets] for x, y, z in index]


def smoothed(values, ids, dims, amount):
    """Array (N, ...) moved by `amount` towards the mean of their neighbours."""
    old = np.asarray(values, np.float64)
    new = old.copy()
    for i, around in enumerate(neighbours(ids, dims)):
        around = [j for j in around if j is not None]
        if around:
            new[i] += amount * (old[around].mean(axis=0) - old[i])
    return new
