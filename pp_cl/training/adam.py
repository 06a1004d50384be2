"""Adam of the network and of the points, and exponential averages of the weights.

Dense Adam is torch's: every row moves in every step by its momentum, seen or not. Lazy Adam leaves
a row alone until it receives a gradient again, and then makes up for the steps between.
docs/maths.md states the difference.
"""

import math

import numpy as np

from pp_cl.device.scan import nonzero

BETA1, BETA2 = 0.9, 0.999  # Kingma & Ba 2015; cl/training/adam.cl knows them too
GOLDEN = 0x9E3779B1  # 2^32 over the golden ratio: seeds of successive steps lie far apart


def moment_scale(eps):
    """The power of two by which moments in 16 bits are multiplied: it takes eps to about 2^-6.

    A half holds 2^-14 to 2^16 with all its bits, so these are eps/256 to 4 million eps; below, the
    gradient hardly moves anything.
    """
    return 2.0 ** (-6 - round(math.log2(eps)))


def _step_arguments(step, rate, eps):
    """The kernels' scalars: rate (m/c1) / (sqrt(v/c2) + eps) is (rate sqrt(c2)/c1) m / (sqrt(v) +
    eps sqrt(c2)).
    """
    root = math.sqrt(1 - BETA2**step)
    return {"rate": rate * root / (1 - BETA1**step), "eps": eps * root}


def _same_shape(**arrays):
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"arrays of one shape wanted: {shapes}")


def adam_update(dev, parameter, grad, m, v, step, rate, eps):
    """One Adam step of `parameter`, in place.

    parameter, grad, m, v: float32 arrays of one shape, any; m and v start as zeros. step: from 1
    on. Raises ValueError when the shapes differ.
    """
    _same_shape(parameter=parameter, grad=grad, m=m, v=v)
    dev.program("training/adam").launch(
        "adam_update",
        -(-parameter.size // 16),
        n=parameter.size,
        grad=grad,
        parameter=parameter,
        m=m,
        v=v,
        **_step_arguments(step, rate, eps),
    )


class Touched:
    """Lists the points that received a gradient; its scratch is kept from step to step."""

    def __init__(self, dev):
        self.dev = dev
        self.flags = None

    def rows(self, seen, grad_point_features, grad_opacity):
        """(S) uint32, ascending: the seen points with a gradient that is not 0. Waits for the
        device.

        seen: (?) uint32 indices. grad_point_features: (N, 16). grad_opacity: (N). Only the rows
        seen are read.
        """
        n = len(grad_opacity)
        if self.flags is None or len(self.flags) != n:
            self.flags = self.offsets = self.indices = None  # released first
            self.flags, self.indices = (
                self.dev.empty((n,), np.uint32),
                self.dev.empty((n,), np.uint32),
            )
            self.offsets = self.dev.empty((n + 1,), np.uint32)
        self.dev.fill(self.flags, 0)
        self.dev.program("training/adam").launch(
            "adam_touched",
            len(seen),
            s=len(seen),
            seen=seen,
            touched=self.flags,
            grad_point_features=grad_point_features,
            grad_opacity=grad_opacity,
        )
        return self.indices[: nonzero(self.dev, self.flags, self.offsets, self.indices)]


def rest_table():
    """(1024, 4) float32: what k = 0, 1, ... steps without a gradient do, as cl/training/adam.cl's
    adam_rest reads it.

    beta1^1024 is 0 in float32.
    """
    k, rho = np.arange(1024.0), BETA1 / math.sqrt(BETA2)
    return np.stack([BETA1**k, BETA2**k, rho * (1 - rho**k) / (1 - rho), 0 * k], 1).astype(
        np.float32
    )


class PointAdam:
    """Adam of per-point arrays: begin() a step, then update each array.

    lazy: a step updates the rows that it lists; else all. scale: of SH moments in 16 bits
    (moment_scale); None: in 32.
    """

    def __init__(self, dev, lazy=False, scale=None):
        self.dev = dev
        self.defines = {"LAZY": int(lazy)}
        self.scale = scale
        self.kinds = ("m", "v") if scale is None else ("mv",)
        self.rows, self.rest = dev.zeros((1,), np.uint32), dev.zeros((1, 4))  # nobody reads these
        self.table = dev.upload(rest_table())

    def begin(self, step, n):
        """Begin a step, from 1 on, that updates all n points."""
        self.step, self.count = step, n

    def begin_lazy(self, step, rows, last):
        """Begin a step that updates listed rows.

        rows: (S) uint32 point indices, each once. last: (N) uint32, each point's last step, 0 at
        first; the present one is noted.
        """
        self.step, self.count, self.rows = step, len(rows), rows
        if len(self.rest) != len(last):
            self.rest = None  # released first
            self.rest = self.dev.empty((len(last), 4))
        self._launch(
            "adam_rest",
            step=step,
            t=len(self.table),
            log_beta2=math.log2(BETA2),
            table=self.table,
            last=last,
        )

    def update_opacity(self, grad_opacity, opacity, m, v, rate, eps):
        """Update opacities, which stay in [0, 1]. All arrays: (N); m and v start as zeros."""
        self._launch(
            "adam_opacity_update",
            grad_opacity=grad_opacity,
            opacity=opacity,
            m=m,
            v=v,
            **_step_arguments(self.step, rate, eps),
        )

    def sh_moments(self, block, n):
        """{kind: zeros} for n points: "m" and "v" (N, count, 16) or, in 16 bits, both as "mv" (N,
        count, 2, 16).
        """
        if self.scale is None:
            return {kind: self.dev.zeros((n, block.count, 16)) for kind in self.kinds}
        return {kind: self.dev.zeros((n, block.count, 2, 16), np.float16) for kind in self.kinds}

    def update_sh(self, block, grid, camera, ids, grad_point_features, sh, moments, rate, eps):
        """Update the SH coefficients of one block.

        block: points.ShBlock. grid: (8,) of Grid.packed(). camera: (20,) of the view the gradient
        belongs to. ids: (N,) uint32 grid ids. grad_point_features: (N, 16) gradient of the points'
        features in that view. sh: (N, block.count, 16). moments: as sh_moments() made them.
        """
        kernel, defines = "adam_sh_update", {"FIRST": block.first, "K": block.count}
        if self.scale is not None:
            kernel, defines["SCALE"] = "adam_sh_update_half", f"{self.scale!r}f"
            moments = {"moments": moments["mv"], "seed": self.step * GOLDEN % 2**32}
        self._launch(
            kernel,
            defines,
            grid=grid,
            camera=camera,
            ids=ids,
            sh=sh,
            grad_point_features=grad_point_features,
            **moments,
            **_step_arguments(self.step, rate, eps),
        )

    def _launch(self, kernel, defines=None, **arguments):
        self.dev.program("training/adam", **self.defines, **defines or {}).launch(
            kernel, self.count, s=self.count, rows=self.rows, rest=self.rest, **arguments
        )


def ema_update(dev, average, parameter, weight):
    """Move an average, in place: average += weight * (parameter - average). A weight of 1 copies,
    whatever it held.

    average, parameter: float32 arrays of one shape, any. Raises ValueError when the shapes differ.
    """
    _same_shape(average=average, parameter=parameter)
    if weight == 1:
        dev.copy(average, parameter)
        return
    dev.program("training/adam").launch(
        "ema_update",
        -(-parameter.size // 16),
        n=parameter.size,
        weight=weight,
        parameter=parameter,
        average=average,
    )
