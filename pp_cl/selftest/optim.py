"""Cases of what changes parameters: Adam, RMSprop of the SH coefficients, moving averages,
smoothing, the opacities of split points.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.raster.points import SH_DEGREES, sh_blocks
from pp_cl.raster.project import ProjectedPoints
from pp_cl.reference import optim
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.selftest.case import EPS, SIZES, Case, Check, absolute, each, exact, finite, relative
from pp_cl.training.optim import adam_update, ema_take, ema_update, rmsprop_update
from pp_cl.training.smooth import Smoother
from pp_cl.training.state import split_opacity

GRID = Grid((-0.7, -0.5, -0.6), 0.05, (23, 19, 31))
SH_EPS = 4e-7  # of the tiny preset
RATES = (0.1, 0.05, 0.025)
EYE = np.array([1.5, -2.5, 1.2])
CAMERA = Camera.look_at(EYE, (0.1, 0.2, -0.3), fx=100, width=100, height=100)


class Cloud:
    """n points on the grid with random coefficients up to a degree, and their float64 twin."""

    def __init__(self, dev: Device, rng: np.random.Generator, n: int, degree: int = SH_DEGREES[-1]):
        self.dev, self.n, self.steps = dev, n, 0
        self.blocks = sh_blocks(degree)
        ids = np.sort(rng.choice(np.prod(GRID.dims), n, replace=False)).astype(np.uint32)
        count = sum(block.count for block in self.blocks)
        self.start = rng.standard_normal((n, count, 16)).astype(np.float32)
        self.twin = optim.RmsProp(self.start, optim.basis(GRID.positions(ids), EYE)[:, :count])
        self.sh = [dev.upload(self.start[:, b.first : b.first + b.count]) for b in self.blocks]
        self.v, self.last_step = dev.zeros((n, 16)), dev.zeros((n,), np.uint32)
        self._points = seen_points(dev, GRID.positions(ids), CAMERA)

    def step(
        self,
        grad_features: np.ndarray,
        shaded: np.ndarray,
        step: int | None = None,
        *,
        rates: Sequence[float] = RATES,
    ) -> None:
        """One step, or that of another number. grad_features: (N, 16), of which those of `shaded`
        count.
        """
        self.steps = step or self.steps + 1
        seen = np.isin(np.arange(self.n), shaded)[:, None]
        features = self.dev.upload(grad_features[shaded], np.float32)
        rmsprop_update(
            self.dev,
            self.steps,
            self._points,
            self.dev.upload(shaded, np.uint32),
            features,
            self.sh,
            v=self.v,
            last_step=self.last_step,
            rates=rates,
            eps=SH_EPS,
        )
        self.twin.step(
            self.steps, np.where(seen, grad_features, 0), np.repeat(rates, (1, 3, 5)), SH_EPS
        )

    def coefficients(self) -> np.ndarray:
        """(N, count, 16) float32 on the host."""
        return np.concatenate([array.get() for array in self.sh], axis=1)

    def second_moment(self) -> np.ndarray:
        """(N, 16) float64: with the decay that waits."""
        waited = self.steps - self.last_step.get().astype(np.float64)
        return self.v.get() * 0.999 ** waited[:, None]


def seen_points(dev: Device, positions: np.ndarray, camera: Camera) -> ProjectedPoints:
    """Points (N, 3) in the camera's axes; a view's other arrays are absent."""
    towards = positions - camera.eye
    distance = np.linalg.norm(towards, axis=1)
    rows = np.column_stack([towards @ camera.pose[:, :3], distance]).astype(np.float32)
    absent = (dev.zeros((1,)),) * 3
    return ProjectedPoints("soft", dev.upload(camera.packed((2.0, 6.0))), dev.upload(rows), *absent)


def gradients(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 16) float32 of the features; every third point's are 0."""
    features = 1e-4 * rng.standard_normal((n, 16))
    features[::3] = 0
    return features.astype(np.float32)


def _adam(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Parameters and moments after twenty steps; the first step is the rate."""
    for n in SIZES:
        grads = 1e-3 * rng.standard_normal((20, n))
        for eps in (1e-8, 1e-15):
            twin, parameter, state = adam_steps(
                dev, rng.standard_normal(n), grads, rate=0.01, eps=eps
            )
            # the parameter is rounded in each step, by half EPS of its size; rarely the same way
            yield relative(parameter, twin.parameter, 3e-7)
            yield each(state["m"].get(), twin.m, 8 * EPS, floor=1e-3)
            yield each(state["v"].get(), twin.v, 8 * EPS)
    _, parameter, _ = adam_steps(dev, np.zeros(257), np.full((1, 257), -3e-4), rate=0.5, eps=1e-15)
    # what 1 - beta2 in float32 would miss by 7e-6
    yield each(parameter, np.full(257, 0.5), 4e-7)


def adam_steps(
    dev: Device, start: np.ndarray, grads: np.ndarray, **options: Any
) -> tuple[optim.Adam, np.ndarray, dict[str, Array]]:
    """(float64 twin, parameter, moments) after a step with each gradient. options: of
    adam_update().
    """
    parameter = dev.upload(start, np.float32)
    twin, state = optim.Adam(parameter.get()), {kind: dev.zeros(parameter.shape) for kind in "mv"}
    for step, grad in enumerate(grads.astype(np.float32), 1):
        adam_update(dev, parameter, dev.upload(grad), state, step=step, **options)
        twin.step(grad, **options)
    return twin, parameter.get(), state


def _adam_extremes(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Gradients of 1e-20 to 1e10, of which float32 cannot square all; and of 0."""
    for scale in (1e-20, 1e-12, 1e-3, 1e10):
        for eps in (1e-8, 1e-15):
            grads = scale * rng.standard_normal((10, 31))
            twin, parameter, _ = adam_steps(dev, np.zeros(31), grads, rate=0.1, eps=eps)
            # m / (sqrt(v) + eps): a few roundings, each step
            yield relative(parameter, twin.parameter, 1e-5)
    start = rng.standard_normal(33).astype(np.float32)
    _, parameter, state = adam_steps(dev, start, np.zeros((3, 33)), rate=0.5, eps=1e-15)
    yield exact(parameter, start)
    yield exact(state["v"].get(), np.zeros(33))


def _rmsprop(degree: int, dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Of harmonics by the direction from the eye; points without a gradient keep their values, and
    their second moments decay.
    """
    for n in SIZES:
        cloud = Cloud(dev, rng, n, degree)
        for _ in range(8):
            cloud.step(gradients(rng, n), np.flatnonzero(rng.random(n) < 0.4))
        yield from _rmsprop_checks(cloud)
    for step in (100, 50_000, 10**8):
        cloud = Cloud(dev, rng, 33, degree)
        for at in (1, step, step + 1):
            cloud.step(gradients(rng, 33), np.arange(33), at)
        yield from _rmsprop_checks(cloud)


def _rmsprop_checks(cloud):
    yield relative(cloud.coefficients(), cloud.twin.sh, 1e-6)
    yield relative(cloud.second_moment(), cloud.twin.v, 3e-6)  # a sum of squares


def _rmsprop_extremes(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Gradients of 1e-20 to 1e10, of which float32 cannot square all; of 0 and -0; NaN stays."""
    for scale in (1e-20, 1e-12, 1e-3, 1e10):
        cloud = Cloud(dev, rng, 31)
        for _ in range(10):
            cloud.step(scale / 1e-4 * gradients(rng, 31), np.arange(31))
        yield relative(cloud.coefficients(), cloud.twin.sh, 1e-6)
    cloud = Cloud(dev, rng, 33)
    grad = np.zeros((33, 16))
    grad[1], grad[2, 5] = -0.0, np.nan
    cloud.step(grad, np.arange(33))
    expected = cloud.start.copy()
    expected[2, :, 5] = np.nan
    yield exact(np.isnan(cloud.coefficients()), np.isnan(expected))
    yield exact(np.nan_to_num(cloud.coefficients()), np.nan_to_num(expected))


def _bounded(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Huge gradients keep opacities and offsets in their bounds, at the values of float64."""
    for bounds in ((0.0, 1.0), (-0.5, 0.5)):
        grads = 1e4 * (rng.standard_normal((20, 257)) + np.linspace(-2, 2, 257))
        options = {"rate": 0.03, "eps": 1e-15, "bounds": bounds}
        twin, moved, _ = adam_steps(dev, rng.uniform(*bounds, 257), grads, **options)
        yield finite(moved)
        yield exact([moved.min(), moved.max()], bounds)
        yield absolute(moved, twin.parameter, 2e-6)  # twenty moves of 0.03


def _ema(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    for n in SIZES:
        old, new = rng.standard_normal((2, n)).astype(np.float32)
        ema = dev.upload(old)
        ema_update(dev, ema, dev.upload(new), 0.01)
        expected = old + 0.01 * (new.astype(np.float64) - old)
        yield relative(ema.get(), expected, 2 * EPS)
        old, new = rng.standard_normal((2, n, 16)).astype(np.float32)
        ema, taken = dev.empty(old.shape, np.float16), dev.empty(old.shape)
        for parameter, weight in ((old, 1.0), (new, 0.1)):
            ema_update(dev, ema, dev.upload(parameter), weight)
        ema_take(dev, ema, taken)
        expected = old + 0.1 * (new.astype(np.float64) - old)
        yield relative(taken.get(), expected, 2.0**-10)  # two roundings to 16 bits


def _smooth(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Neighbours on the grid, and the step towards their mean."""
    dims = (7, 8, 9)
    for n in SIZES:
        ids = np.sort(rng.choice(np.prod(dims), n, replace=False)).astype(np.uint32)
        smoother = Smoother(dev, dev.upload(Grid((0, 0, 0), 1, dims).packed()), dev.upload(ids))
        table = [
            [2**32 - 1 if j is None else j for j in row] for row in optim.neighbours(ids, dims)
        ]
        yield exact(smoother.neighbours.get(), table)
        values = rng.standard_normal((n, 3, 16)).astype(np.float32)
        for amount in (0.06, 1.0):
            sh = dev.upload(values)
            smoother.smooth(sh, amount)
            expected = optim.smoothed(values, ids, dims, amount)
            yield relative(sh.get(), expected, 4 * EPS)  # a mean of up to six


def _refine(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """1 - sqrt(1 - o), which cancels for small opacities."""
    for n in SIZES:
        opacity = rng.uniform(0, 1, n).astype(np.float32)
        opacity[::5], opacity[1::5], opacity[2::5] = 0, 1, 1e-7
        array = dev.upload(opacity)
        split_opacity(dev, array)
        wide = opacity.astype(np.float64)
        yield each(array.get(), wide / (1 + np.sqrt(1 - wide)), 3e-7)


CASES = (
    Case("adam: arrays", _adam),
    Case("adam: gradients of 0, 1e-20 and 1e10", _adam_extremes),
    Case("adam: at the bounds", _bounded),
    *(Case(f"rmsprop: degree {d}", partial(_rmsprop, d)) for d in SH_DEGREES),
    Case("rmsprop: gradients of 0, 1e-20, 1e10 and NaN", _rmsprop_extremes),
    Case("training: moving average", _ema),
    Case("training: smoothing", _smooth),
    Case("training: split opacities", _refine),
)
