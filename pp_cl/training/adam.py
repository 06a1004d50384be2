"""Adam of the network and of the points, and exponential moving averages (EMA) of parameters.

Dense Adam is torch's: every row moves in every step by its momentum, whether it received a gradient
or not. Lazy Adam skips the SH coefficients of points without a gradient; what the skipped steps
would have moved is added in closed form to the features of a point that is seen again
(PointAdam.add_pending), and to its coefficients when it receives a gradient again. docs/maths.md
states the difference.
"""

import math
from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.form import lanes, row_parts
from pp_cl.device.launch import Program
from pp_cl.device.scan import nonzero
from pp_cl.raster.sh import ShBlock

BETA1, BETA2 = 0.9, 0.999  # Kingma & Ba 2015
GOLDEN = 0x9E3779B1  # 2^32 over the golden ratio: seeds of successive steps lie far apart
# What fewer skipped steps do stands in a table; beta1 to this power is 0 in float32.
TABLE_STEPS = 1024


def adam_program(dev: Device, **defines) -> Program:
    """cl/training/adam.cl with the betas of this module."""
    decays = {"DECAY1": f"{1 - BETA1:.9g}f", "DECAY2": f"{1 - BETA2:.9g}f"}
    return dev.program("training/adam", LANES=lanes(dev), **decays, **defines)


def moment_scale(eps: float) -> float:
    """The power of two by which moments in 16 bits are multiplied: it takes eps to about 2^-6.

    A half holds 2^-14 to 2^16 with all its bits, so these are eps/256 to 4 million eps; below, the
    gradient hardly moves anything.
    """
    return 2.0 ** (-6 - round(math.log2(eps)))


def _rate_and_eps(step, rate, eps):
    """The kernels' scalars: rate (m/c1) / (sqrt(v/c2) + eps) is (rate sqrt(c2)/c1) m / (sqrt(v) +
    eps sqrt(c2)).
    """
    root = math.sqrt(1 - BETA2**step)
    return {"rate": rate * root / (1 - BETA1**step), "eps": eps * root}


def _same_shape(**arrays):
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"arrays of one shape wanted: {shapes}")


def adam_update(
    dev: Device,
    parameter: Array,
    grad: Array,
    moments: dict[str, Array],
    *,
    step: int,
    rate: float,
    eps: float,
) -> None:
    """One dense Adam step of `parameter`, in place.

    parameter, grad, moments "m" and "v": float32 arrays of one shape, any; the moments start as
    zeros. step: from 1 on. Raises ValueError when the shapes differ.
    """
    _same_shape(parameter=parameter, grad=grad, **moments)
    adam_program(dev).launch(
        "adam_update",
        -(-parameter.size // lanes(dev)),
        n=parameter.size,
        grad=grad,
        parameter=parameter,
        **moments,
        **_rate_and_eps(step, rate, eps),
    )


class PointsWithGradient:
    """Lists the points that received a gradient."""

    def __init__(self, dev: Device):
        self.dev = dev
        self._buffers = Buffers(dev)

    @staticmethod
    def table(n: int) -> Table:
        """The scratch for n points, `rows` with the result among it."""
        sizes = {"has_gradient": n, "offsets": n + 1, "rows": n}
        return {name: ((size,), np.uint32) for name, size in sizes.items()}

    def rows(self, shaded: Array, grad_point_features: Array) -> Array:
        """(S) uint32, ascending: the shaded points with a gradient that is not 0, valid until the
        next call. Waits for the device.

        shaded: (?) uint32 indices. grad_point_features: (N, 16), only the shaded rows are read.
        """
        buffers = self._buffers
        buffers.require(self.table(len(grad_point_features)))
        self.dev.fill(buffers.has_gradient, 0)
        adam_program(self.dev).launch(
            "adam_flag_gradients",
            len(shaded),
            s=len(shaded),
            shaded=shaded,
            grad_point_features=grad_point_features,
            has_gradient=buffers.has_gradient,
        )
        return nonzero(self.dev, buffers.has_gradient, buffers.offsets, buffers.rows).array


def skipped_steps_table() -> np.ndarray:
    """(TABLE_STEPS, 4) float32: what k = 0, 1, ... steps without a gradient do, as adam_skipped in
    cl/training/adam.cl reads it.
    """
    k, rho = np.arange(float(TABLE_STEPS)), BETA1 / math.sqrt(BETA2)
    return np.stack([BETA1**k, BETA2**k, rho * (1 - rho**k) / (1 - rho), 0 * k], 1).astype(
        np.float32
    )


@dataclass(frozen=True)
class UpdatedPoints:
    """The points whose SH one step updates: all N, or those listed by lazy Adam.

    step: from 1 on. count: S, how many they are. rows: (S) uint32, their indices, and skipped:
    (?, 4) float32, what each one's skipped steps did, where lazy; else not read.
    """

    step: int
    count: int
    rows: Array
    skipped: Array
    lazy: bool


@dataclass(frozen=True)
class Directions:
    """Where the SH of points are evaluated: in the directions from the eye to them.

    grid: (8) of Grid.packed(). camera_buffer: (20). ids: (N) uint32 grid ids.
    """

    grid: Array
    camera_buffer: Array
    ids: Array

    def arguments(self) -> dict[str, Array]:
        """By the kernels' names."""
        return {"grid": self.grid, "camera": self.camera_buffer, "ids": self.ids}


@dataclass(frozen=True)
class ShGradient:
    """The gradient of the SH coefficients in one view, as the factors of a rank-one product: the
    harmonics of the directions, and the gradient of the points' features, (N, 16).
    """

    directions: Directions
    grad_point_features: Array


class PointAdam:
    """Adam of per-point arrays: choose the points of a step, then update each array.

    scale: of SH moments in 16 bits (moment_scale); None: in 32.
    """

    def __init__(self, dev: Device, scale: float | None = None):
        self.dev = dev
        self.scale = scale
        self._unread = {"rows": dev.zeros((1,), np.uint32), "skipped": dev.zeros((1, 4))}
        self._skipped_steps = dev.upload(skipped_steps_table())
        self._buffers = Buffers(dev)

    @staticmethod
    def table(n: int) -> Table:
        """The scratch of lazy Adam for n points."""
        return {"skipped": ((n, 4), np.float32)}

    def all_points(self, step: int, n: int) -> UpdatedPoints:
        """All n points, for a step from 1 on."""
        return UpdatedPoints(step, n, **self._unread, lazy=False)

    def listed_points(
        self, step: int, rows: Array, last_step: Array, *, updating: bool = True
    ) -> UpdatedPoints:
        """The listed points, for a step from 1 on; valid until the next call.

        rows: (S) uint32 point indices, each once. last_step: (N) uint32, the step that updated
        each point last, 0: none; where `updating`, it becomes `step` for the listed ones.
        """
        self._buffers.require(self.table(len(last_step)))
        updated = UpdatedPoints(step, len(rows), rows, self._buffers.skipped, lazy=True)
        self._launch(
            updated,
            "adam_skipped",
            updated.count,
            step=step,
            updating=int(updating),
            t=TABLE_STEPS,
            log_beta2=math.log2(BETA2),
            skipped_steps=self._skipped_steps,
            last_step=last_step,
        )
        return updated

    def update_opacity(
        self,
        step: int,
        grad_opacity: Array,
        opacity: Array,
        moments: dict[str, Array],
        *,
        rate: float,
        eps: float,
    ) -> None:
        """Update all opacities, clamped to [0, 1]. All arrays: (N); moments "m" and "v" start as
        zeros. step: from 1 on.
        """
        adam_program(self.dev).launch(
            "adam_opacity_update",
            len(opacity),
            n=len(opacity),
            grad_opacity=grad_opacity,
            opacity=opacity,
            **moments,
            **_rate_and_eps(step, rate, eps),
        )

    def add_pending(
        self,
        listed: UpdatedPoints,
        block: ShBlock,
        directions: Directions,
        point_features: Array,
        *,
        moments: dict[str, Array],
        rate: float,
        eps: float,
    ) -> None:
        """Add to the listed rows of point_features (N, 16) what an update in this step of the SH
        coefficients of one block will first catch up with. The rest: as for update_sh().
        """
        self._launch(
            listed,
            "adam_sh_pending" if self.scale is None else "adam_sh_pending_16bit",
            listed.count * row_parts(self.dev),
            self._defines(block),
            point_features=point_features,
            **moments,
            **directions.arguments(),
            **_rate_and_eps(listed.step, rate, eps),
        )

    def update_sh(
        self,
        updated: UpdatedPoints,
        block: ShBlock,
        gradient: ShGradient,
        sh: Array,
        *,
        moments: dict[str, Array],
        rate: float,
        eps: float,
    ) -> None:
        """Update the SH coefficients of one block. sh: (N, block.count, 16). moments: start as
        zeros, "m" and "v" shaped like sh, or in 16 bits both as "mv" (N, block.count, 2, 16).
        """
        kernel, arguments = "adam_sh_update", moments
        if self.scale is not None:
            kernel = "adam_sh_update_16bit"
            arguments = moments | {"seed": updated.step * GOLDEN % 2**32}
        self._launch(
            updated,
            kernel,
            updated.count * row_parts(self.dev),
            self._defines(block),
            sh=sh,
            grad_point_features=gradient.grad_point_features,
            **gradient.directions.arguments(),
            **arguments,
            **_rate_and_eps(updated.step, rate, eps),
        )

    def _defines(self, block):
        """Options of the kernels of SH."""
        defines = {"SH_FIRST": block.first, "SH_COUNT": block.count}
        return defines if self.scale is None else {**defines, "SCALE": f"{self.scale!r}f"}

    def _launch(self, updated, kernel, size, defines=None, **arguments):
        adam_program(self.dev, LAZY=int(updated.lazy), **defines or {}).launch(
            kernel,
            size,
            s=updated.count,
            rows=updated.rows,
            skipped=updated.skipped,
            **arguments,
        )


def ema_update(dev: Device, ema: Array, parameter: Array, weight: float) -> None:
    """Move an EMA, in place: ema += weight * (parameter - ema). A weight of 1 copies, whatever it
    held.

    ema, parameter: float32 arrays of one shape, any. Raises ValueError when the shapes differ.
    """
    _same_shape(ema=ema, parameter=parameter)
    if weight == 1:
        dev.copy(ema, parameter)
        return
    adam_program(dev).launch(
        "ema_update",
        -(-parameter.size // lanes(dev)),
        n=parameter.size,
        weight=weight,
        parameter=parameter,
        ema=ema,
    )


class Ema:
    """Exponential moving averages of named parameters.

    arrays: {name: float32 array like the parameter}, empty before the first update.
    """

    def __init__(self, dev: Device):
        self.dev = dev
        self.arrays: dict[str, Array] = {}

    def update(self, parameters: dict[str, Array], weight: float) -> None:
        """Move the averages towards the parameters by `weight`; the first call starts them there,
        as does a weight of 1.
        """
        for name, parameter in parameters.items():
            if name in self.arrays:
                ema_update(self.dev, self.arrays[name], parameter, weight)
            else:
                self.arrays[name] = self.dev.empty(parameter.shape)
                self.dev.copy(self.arrays[name], parameter)

    def apply(self, parameters: dict[str, Array]) -> None:
        """Copy the averages, if there are any, into the parameters and release them."""
        for name in list(self.arrays):
            self.dev.copy(parameters[name], self.arrays.pop(name))

    def restore(self, parameters: dict[str, Array], stored: dict[str, np.ndarray]) -> None:
        """Take over stored averages, by the parameters' names. Raises ValueError for another
        size.
        """
        for name, array in stored.items():
            self.arrays[name] = self.dev.upload(array.reshape(parameters[name].shape))
