"""Cases of the kernels that change parameters: Adam, RMSprop, averages, smoothing, splits."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.layers.conv import GradientParts
from pp_cl.engine.raster.footprint import FOOTPRINTS, Footprint
from pp_cl.engine.raster.points import SH_DEGREES, PointCloud
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.training.optim import POINT_EPS, adam_update, ema_update, rmsprop_update
from pp_cl.engine.training.schedule import Rates
from pp_cl.engine.training.smooth import Smoother
from pp_cl.engine.training.state import PointState, split_opacity
from pp_cl.reference import dense, optim
from pp_cl.selftest.case import EPS, SIZES, Case, absolute, each, exact, finite, relative
from pp_cl.selftest.points import some_ids, some_opacities

GRID = Grid((-0.7, -0.5, -0.6), 0.05, (23, 19, 31))
EPSILONS = {"sh": 4e-7, "offset": POINT_EPS, "opacity": POINT_EPS}  # as in the tiny preset
RATES = Rates(sh=(0.1, 0.05, 0.025), offset=0.01, opacity=0.1, lobe=0.05, network=0.0)
Gradients = dict[str, np.ndarray]
EYE = np.array([1.5, -2.5, 1.2])
CAMERA = Camera.look_at(EYE, (0.1, 0.2, -0.3), fx=100, width=100, height=100)


class Cloud:
    """n random points on the grid, and their float64 twin. kind: of their footprint. start,
    learned(): arrays "sh" (N, count, 16), "offset" (N, kind.offsets), "opacity" (N, 9).
    """

    def __init__(
        self,
        dev: Device,
        rng: np.random.Generator,
        n: int,
        degree: int = SH_DEGREES[-1],
        kind: Footprint = FOOTPRINTS["soft"],
    ):
        self.dev, self.n, self.steps = dev, n, 0
        ids = some_ids(rng, GRID, n)
        self.cloud = PointCloud.create(dev, ids, degree)
        self.cloud.offset, self.cloud.kind = dev.zeros((n, kind.offsets)), kind
        most, count = kind.most_offset, sum(block.count for block in self.cloud.blocks)
        self.start = {
            "sh": rng.standard_normal((n, count, 16)).astype(np.float32),
            "offset": rng.uniform(-most, most, (n, kind.offsets)).astype(np.float32),
            "opacity": some_opacities(rng, n),
        }
        most_sh = kind.most_sh
        np.clip(self.start["sh"][:, 1:], -most_sh, most_sh, out=self.start["sh"][:, 1:])
        for block, array in zip(self.cloud.blocks, self.cloud.sh, strict=True):
            array.set(self.start["sh"][:, block.first : block.first + block.count].copy())
        self.cloud.offset.set(self.start["offset"])
        self.cloud.opacity.set(self.start["opacity"])
        self.positions = GRID.positions(ids)
        directions = dense.directions(self.positions, EYE)
        self.twin = optim.RmsProp(self.start, directions, most, most_sh)
        self.state = PointState(dev, self.cloud)
        self._points = seen_points(dev, self.positions, CAMERA)

    def step(
        self,
        grads: Gradients,
        visible: np.ndarray,
        step: int | None = None,
        *,
        rates: Rates = RATES,
    ) -> None:
        """Take the next step, or the given one. grads: as from gradients(); only those of visible
        points are used.
        """
        self.steps = step or self.steps + 1
        rows = {name: self.dev.upload(g[visible], np.float32) for name, g in grads.items()}
        rmsprop_update(
            self.dev,
            self.steps,
            rates,
            rows["sh"],
            rows["opacity"],
            rows["offset"] if rates.offset else None,
            points=self._points,
            visible=self.dev.upload(visible, np.uint32),
            count=len(visible),
            cloud=self.cloud,
            state=self.state,
            sh_eps=EPSILONS["sh"],
        )
        is_visible = np.isin(np.arange(self.n), visible)
        grads = {name: np.where(is_visible, g.T, 0).T for name, g in grads.items()}
        grads["offset"] = grads["offset"] * (rates.offset > 0)
        by_basis = vars(rates) | {"sh": np.repeat(rates.sh, (1, 3, 5))}
        self.twin.step(self.steps, grads, by_basis, EPSILONS)

    def learned(self) -> dict[str, np.ndarray]:
        """The parameters, float32 on the host."""
        sh = np.concatenate([array.get() for array in self.cloud.sh], axis=1)
        return {"sh": sh, "offset": self.cloud.offset.get(), "opacity": self.cloud.opacity.get()}

    def second_moments(self) -> dict[str, np.ndarray]:
        """The second moments, float64, including decay that is still to be applied."""
        waited = 0.999 ** (self.steps - self.state.last_step.get().astype(np.float64))
        return {name: (v.get().T * waited).T for name, v in self.state.second_moments.items()}


def seen_points(dev: Device, positions: np.ndarray, camera: Camera) -> ProjectedPoints:
    """Points (N, 3) in camera axes as a view has them, without its other arrays."""
    towards = positions - camera.eye
    distance = np.linalg.norm(towards, axis=1)
    rows = np.zeros((len(positions), 8), np.float32)
    rows[:, :4] = np.column_stack([towards @ camera.pose[:, :3], distance])
    record, absent = dev.upload(rows.view(np.uint32)), (dev.zeros((1,)),) * 3
    return ProjectedPoints("soft", dev.upload(camera.packed((2.0, 6.0))), record, *absent, 0.0)


def gradients(rng: np.random.Generator, n: int, scale: float = 1e-4, width: int = 4) -> Gradients:
    """{"sh": (n, 16), "offset": (n, width), "opacity": (n,)}, 0 for every third point."""
    grads = {}
    for name, shape in (("sh", (n, 16)), ("offset", (n, width)), ("opacity", (n,))):
        grads[name] = (scale * rng.standard_normal(shape)).astype(np.float32)
        grads[name][::3] = 0
    return grads


def _adam(dev, rng):
    """Parameters and moments after twenty steps."""
    for n in SIZES:
        grads = 1e-3 * rng.standard_normal((20, n))
        for eps in (1e-8, 1e-15):
            start = rng.standard_normal(n)
            twin, parameter, state = adam_steps(dev, start, grads, rate=0.01, eps=eps)
            # each step rounds the parameter by half EPS of its size, rarely always the same way
            yield relative(parameter, twin.parameter, 3e-7)
            yield each(state["m"], twin.m, 8 * EPS, floor=1e-3)
            yield each(state["v"], twin.v, 8 * EPS)


def _adam_first(dev, rng):
    """The first step has the size of the rate."""
    grad, rate = np.full((1, 257), -3e-4, np.float32), 0.5
    _, parameter, _ = adam_steps(dev, np.zeros(257), grad, rate=rate, eps=1e-15)
    v = (np.float32(1) - np.float32(optim.BETA2)) * grad[0] * grad[0]
    naive = -rate * grad[0] / np.sqrt(v / np.float32(1 - optim.BETA2))
    yield each(parameter, np.full(257, rate), 4e-7, naive=naive)


def adam_steps(
    dev: Device, start: np.ndarray, grads: np.ndarray, **options: Any
) -> tuple[optim.Adam, np.ndarray, dict[str, np.ndarray]]:
    """(float64 twin, parameters, moments "m" and "v") after a step with each halved gradient, in
    two parts: weights, and the last 16 numbers as biases.
    """
    n, rows = grads.shape[1], -(-grads.shape[1] // 16)
    whole = np.zeros((16 * rows,), np.float32)
    whole[:n] = start
    parameter, moments = dev.upload(whole), {kind: dev.zeros(whole.shape) for kind in "mv"}
    twin, partial = optim.Adam(whole[:n].copy()), np.zeros((2, rows, 16), np.float32)
    table = dev.upload([[0, rows, 1, 2, 0, 0, rows - 1, 1]], np.int32)
    for step, grad in enumerate(grads.astype(np.float32), 1):
        partial.reshape(2, -1)[:, :n] = 0.5 * grad, 1.5 * grad
        parts = GradientParts(rows, table, dev.upload(partial.ravel()))
        adam_update(dev, parameter, parts, moments, step=step, **options)
        twin.step(grad, **options)
    moment_values = {kind: array.get()[:n] for kind, array in moments.items()}
    return twin, parameter.get()[:n], moment_values


def _adam_extremes(dev, rng):
    """Gradients from 1e-20 to 1e10, not all of which float32 can square, and of 0."""
    for scale in (1e-20, 1e-12, 1e-3, 1e10):
        for eps in (1e-8, 1e-15):
            grads = scale * rng.standard_normal((10, 31))
            twin, parameter, _ = adam_steps(dev, np.zeros(31), grads, rate=0.1, eps=eps)
            # m / (sqrt(v) + eps): a few roundings, each step
            yield relative(parameter, twin.parameter, 1e-5)
    start = rng.standard_normal(33).astype(np.float32)
    _, parameter, state = adam_steps(dev, start, np.zeros((3, 33)), rate=0.5, eps=1e-15)
    yield exact(parameter, start)
    yield exact(state["v"], np.zeros(33))


def _adam_huge(dev, rng):
    """Gradients whose squares overflow float32."""
    grads = (1e30 * rng.choice([-1, 1], (5, 31))).astype(np.float32)
    twin, parameter, _ = adam_steps(dev, np.zeros(31), grads, rate=0.1, eps=1e-8)
    naive = _textbook_adam(np.zeros(31, np.float32), grads, rate=0.1, eps=1e-8)
    yield relative(parameter, twin.parameter, 1e-5, naive=naive)


def _textbook_adam(parameter, grads, *, rate, eps, beta1=0.9):
    """The parameter after a step with each gradient, all float32."""
    m = v = np.zeros_like(parameter)
    for t, g in enumerate(grads, 1):
        m = beta1 * m + (1 - beta1) * g
        v = optim.BETA2 * v + (1 - optim.BETA2) * (g * g)
        step = m / (np.sqrt(v / (1 - optim.BETA2**t)) + eps)
        parameter = parameter - rate / (1 - beta1**t) * step
    return parameter


def _rmsprop(degree, dev, rng):
    """Points without a gradient keep their values, and their second moments decay."""
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
    cloud = Cloud(dev, rng, 33, degree)
    cloud.step(gradients(rng, 33), np.arange(33), rates=replace(RATES, offset=0.0))
    yield from _rmsprop_checks(cloud)


def _rmsprop_checks(cloud):
    moments = cloud.second_moments()
    for name, values in cloud.learned().items():
        yield relative(values, cloud.twin.values[name], 1e-6)
        yield relative(moments[name], cloud.twin.v[name], 3e-6)  # a sum of squares


def _rmsprop_extremes(dev, rng):
    """Gradients some of whose squares overflow or underflow float32."""
    for scale in (1e-20, 1e-12, 1e-3, 1e10):
        cloud = Cloud(dev, rng, 31)
        for _ in range(10):
            cloud.step(gradients(rng, 31, scale), np.arange(31))
        for name, values in cloud.learned().items():
            yield relative(values, cloud.twin.values[name], 1e-6 if name == "sh" else 1e-5)


def _rmsprop_huge(dev, rng):
    """Gradients whose squares overflow float32."""
    cloud = Cloud(dev, rng, 31)
    grads = {name: np.sign(g) * np.float32(1e30) for name, g in gradients(rng, 31).items()}
    for _ in range(5):
        cloud.step(grads, np.arange(31))
    how = {"rate": RATES.offset, "eps": POINT_EPS, "beta1": 0}
    offset = _textbook_adam(cloud.start["offset"], [grads["offset"]] * 5, **how)
    for name, values in cloud.learned().items():
        naive = offset if name == "offset" else None
        yield relative(values, cloud.twin.values[name], 1e-5, naive=naive)


def _rmsprop_nothing(dev, rng):
    """NaN does not spread; a gradient of a single parameter moves only that parameter."""
    cloud, grads = Cloud(dev, rng, 33), gradients(rng, 33, 0.0)
    grads["sh"][1] = -0.0
    grads["sh"][2, 5] = grads["opacity"][4] = grads["offset"][7, 1] = np.nan
    grads["opacity"][10], grads["offset"][13, 3] = 1e-4, -1e-4
    cloud.step(grads, np.arange(33))
    for name, values in cloud.learned().items():
        expected, naive = cloud.twin.values[name], None
        if name == "offset":
            naive = grads[name] / np.sqrt(np.float32(1 - optim.BETA2) * grads[name] ** 2)
        yield exact(np.isnan(values), np.isnan(expected), naive=naive)
        yield absolute(np.nan_to_num(values), np.nan_to_num(expected), 1e-6 * RATES.opacity)


def _bounded(dev, rng):
    """Huge gradients leave opacities, offsets and Gaussians' SH above degree 0 in their bounds."""
    for kind in (FOOTPRINTS["soft"], FOOTPRINTS["gaussian"]):
        cloud = Cloud(dev, rng, 257, kind=kind)
        for _ in range(60):
            cloud.step(gradients(rng, 257, 1e4, kind.offsets), np.arange(257))
        most, learned = kind.most_offset, cloud.learned()
        mean, lobes = np.split(learned["opacity"], [1], axis=1)
        for values, bounds in ((learned["offset"], (-most, most)), (mean, (0.0, 1.0))):
            yield exact([values.min(), values.max()], bounds)
        yield exact(abs(lobes).max() <= 1, True)
        for name in ("offset", "opacity"):
            yield finite(learned[name])
            yield absolute(learned[name], cloud.twin.values[name], 1e-5)  # sixty moves
    sh = learned["sh"]
    yield exact([sh[:, 1:].min(), sh[:, 1:].max()], [-kind.most_sh, kind.most_sh])
    yield exact(abs(sh[:, 0]).max() > 1, True)
    yield absolute(sh, cloud.twin.values["sh"], 1e-5)


def _huge_rates(dev, rng):
    """Offsets and opacities go to their bounds, from either side."""
    cloud, rates = Cloud(dev, rng, 257), replace(RATES, offset=1e30, opacity=1e30, lobe=1e30)
    for _ in range(3):
        before, grads = cloud.learned()["offset"], gradients(rng, 257)
        cloud.step(grads, np.arange(257), rates=rates)
    learned, naive = cloud.learned(), before - np.float32(1e30) * np.sign(grads["offset"])
    yield exact(learned["offset"], cloud.twin.values["offset"], naive=naive)
    yield exact(learned["opacity"][:, 0], cloud.twin.values["opacity"][:, 0])
    # a harmonic of 0 in float64 is a rounding error in float32, so either bound is right
    yield exact(abs(learned["opacity"]).max(), 1.0)


def _from_bounds(dev, rng):
    """Opacities of 0 and 1 leave these bounds with the first gradient that points inwards."""
    cloud, grads = Cloud(dev, rng, 257), gradients(rng, 257)
    grads["opacity"][:] = np.where(np.arange(257) % 2, 1e-4, -1e-4)
    for _ in range(12):
        cloud.step(grads, np.arange(257))
    before = cloud.learned()["opacity"][:, 0]
    yield exact(before, np.arange(257) % 2 == 0)
    cloud.step(grads | {"opacity": -grads["opacity"]}, np.arange(257))
    opacity, expected = (x["opacity"][:, 0] for x in (cloud.learned(), cloud.twin.values))
    logit, of_logit = np.log(before / (1 - before)), grads["opacity"] * before * (1 - before)
    moved = logit + np.float32(RATES.opacity) * of_logit / (np.abs(of_logit) + np.float32(1e-15))
    yield absolute(opacity, expected, 1e-5, naive=1 / (1 + np.exp(-moved)))


def _ema(dev, rng):
    for n in SIZES:
        old, new = rng.standard_normal((2, n)).astype(np.float32)
        ema = dev.upload(old)
        ema_update(dev, ema, dev.upload(new), 0.01)
        expected = old + 0.01 * (new.astype(np.float64) - old)
        yield relative(ema.get(), expected, 2 * EPS)


def _smooth(dev, rng):
    """Neighbours on the grid, and the step towards their mean."""
    grid = Grid((0, 0, 0), 1, (7, 17, 9))
    for n in SIZES:
        ids = some_ids(rng, grid, n)
        vertices = grid.coordinates(ids)
        smoother = Smoother(dev, dev.upload(grid.packed()), dev.upload(ids))
        table = [[2**32 - 1 if j is None else j for j in row] for row in optim.neighbours(vertices)]
        yield exact(smoother.neighbours.get(), table)
        values = rng.standard_normal((n, 3, 16)).astype(np.float32)
        for amount in (0.06, 1.0):
            sh = dev.upload(values)
            smoother.smooth(sh, amount)
            expected = optim.smoothed(values, vertices, amount)
            # for a point without neighbours
            naive = values + (0 * values / np.float32(0) - values) if n == 1 else None
            yield relative(sh.get(), expected, 4 * EPS, naive=naive)  # a mean of up to six


def _refine(dev, rng):
    """Opacities become 1 - sqrt(1 - o), which cancels if they are small; harmonics change alike."""
    for n in SIZES:
        opacity = some_opacities(rng, n)
        opacity[::5, 0], opacity[1::5, 0], opacity[2::5, 0] = 0, 1, 1e-7
        array = dev.upload(opacity)
        split_opacity(dev, array)
        wide = opacity.astype(np.float64)
        naive = opacity / (1 + np.sqrt(1 - opacity[:, :1]))
        naive[:, 0] = 1 - np.sqrt(1 - opacity[:, 0])
        yield each(array.get(), wide / (1 + np.sqrt(1 - wide[:, :1])), 3e-7, naive=naive)


CASES = (
    Case("adam: arrays", _adam),
    Case("adam: gradients of 1e30", _adam_huge, hard="v is infinite, the step 0"),
    Case("adam: first step", _adam_first, hard="1 - 0.999 in float32"),
    Case("adam: gradients of 0, 1e-20 and 1e10", _adam_extremes),
    *(Case(f"rmsprop: degree {d}", partial(_rmsprop, d)) for d in SH_DEGREES),
    Case("rmsprop: gradients of 1e-20 and 1e10", _rmsprop_extremes),
    Case("rmsprop: gradients of 1e30", _rmsprop_huge, hard="v is infinite, the step 0"),
    Case("rmsprop: gradients of 0 and NaN", _rmsprop_nothing, hard="0 / sqrt(0), without eps"),
    Case("rmsprop: at the bounds", _bounded),
    Case("rmsprop: rates of 1e30", _huge_rates, hard="values without bounds"),
    Case("rmsprop: opacities of 0 and 1", _from_bounds, hard="logits have no gradient there"),
    Case("training: moving average", _ema),
    Case("training: smoothing", _smooth, hard="the mean of no neighbours is 0 / 0"),
    Case("training: split opacities", _refine, hard="1 - sqrt(1 - o) cancels"),
)
