"""Float64 twins of the kernels that change parameters: Adam as in torch, RMSprop for the points,
and grid smoothing.
"""

import numpy as np

from pp_cl.reference.dense import sh_basis, unbounded_opacities

BETA2 = 0.999  # of both optimisers


class Adam:
    """torch.optim.Adam without weight decay, for one array."""

    def __init__(self, parameter: np.ndarray, beta1: float = 0.9):
        self.parameter, self.beta1 = np.array(parameter, np.float64), beta1
        self.m, self.v, self.t = np.zeros_like(self.parameter), np.zeros_like(self.parameter), 0

    def step(self, grad: np.ndarray, rate: float, eps: float) -> None:
        """One step."""
        self.t += 1
        grad = np.asarray(grad, np.float64)
        self.m += (1 - self.beta1) * (grad - self.m)
        self.v += (1 - BETA2) * (grad * grad - self.v)
        c1, c2 = 1 - self.beta1**self.t, 1 - BETA2**self.t
        self.parameter -= rate / c1 * self.m / (np.sqrt(self.v / c2) + eps)


class RmsProp:
    """The step of cl/training/rmsprop.cl, applied to all points in every step. values: {"sh": (N,
    count, 16), "offset": (N, 4 or 16), "opacity": (N, 9)}. directions: (N, 3) from the eye. most,
    most_sh: bounds of offsets, and of coefficients above degree 0.
    """

    def __init__(
        self,
        values: dict[str, np.ndarray],
        directions: np.ndarray,
        most: float,
        most_sh: float = np.inf,
    ):
        self.directions, self.most, self.most_sh, self.t = directions, most, most_sh, 0
        self.values = {name: np.array(array, np.float64) for name, array in values.items()}
        self.v = {name: np.zeros_like(array) for name, array in self.values.items()}
        self.v |= {"sh": np.zeros((len(directions), 16)), "opacity": np.zeros(len(directions))}

    def step(
        self, t: int, gradients: dict[str, np.ndarray], rates: dict, eps: dict[str, float]
    ) -> None:
        """Step t with gradients "sh", (N, 16) of the features, "offset" and "opacity"; in the steps
        since the last call, gradients were 0. rates: {"sh", "offset", "opacity", "lobe"}.
        """
        moves = {}
        for name, values in gradients.items():
            grad = np.asarray(values, np.float64)
            v = BETA2 ** (t - self.t) * self.v[name]
            v += (1 - BETA2) * grad**2 / (4 * np.pi if name == "sh" else 1)
            self.v[name] = v
            moves[name] = grad / (np.sqrt(v / (1 - BETA2**t)) + eps[name])
        self.t = t
        sh, opacity = self.values["sh"], self.values["opacity"]
        basis, count = sh_basis(self.directions), sh.shape[1]
        by_basis = np.asarray(rates["sh"])[:count] * basis[:, :count]
        sh -= by_basis[:, :, None] * moves["sh"][:, None, :]
        sh[:, 1:] = np.clip(sh[:, 1:], -self.most_sh, self.most_sh)
        offset = self.values["offset"] - rates["offset"] * moves["offset"]
        self.values["offset"] = np.clip(offset, -self.most, self.most)
        unclipped, move = unbounded_opacities(self.directions, opacity), moves["opacity"]
        inward = np.where(np.where(move < 0, unclipped >= 1, unclipped <= 0), 0, move)
        by_degree = np.repeat([rates["lobe"], rates["lobe"] / 2], (3, 5))
        opacity[:, 0] = np.clip(opacity[:, 0] - rates["opacity"] * move, 0, 1)
        lobes = opacity[:, 1:] - by_degree * basis[:, 1:] * inward[:, None]
        opacity[:, 1:] = np.clip(lobes, -1, 1)


def neighbours(vertices: np.ndarray) -> list[list[int | None]]:
    """The indices of each vertex's neighbours -x, +x, -y, +y, -z, +z; None for missing ones."""
    index = {tuple(map(int, vertex)): n for n, vertex in enumerate(vertices)}
    offsets = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]
    return [[index.get((x + a, y + b, z + c)) for a, b, c in offsets] for x, y, z in index]


def smoothed(values: np.ndarray, vertices: np.ndarray, amount: float) -> np.ndarray:
    """The array (N, ...), each value moved by `amount` towards the mean of its grid neighbours:
    first points whose coordinates have an even sum, then the others.
    """
    new = np.array(values, np.float64)
    around, colours = neighbours(vertices), vertices.sum(1) % 2
    for i in np.argsort(colours, kind="stable"):
        known = [j for j in around[i] if j is not None]
        if known:
            new[i] += amount * (new[known].mean(axis=0) - new[i])
    return new
