"""Cases of what a training step does: losses, Adam, smoothing, EMA, refining."""

import itertools
from collections.abc import Iterator
from functools import partial

import numpy as np

from pp_cl.device.device import Device
from pp_cl.layers.choice import make_policy
from pp_cl.raster.points import SH_DEGREES
from pp_cl.reference import loss as reference_loss
from pp_cl.reference import optim
from pp_cl.reference.lpips import lpips, lpips_gradient, random_weights
from pp_cl.scene.grid import Grid
from pp_cl.selftest.case import (
    EPS,
    SIZES,
    Case,
    Check,
    absolute,
    each,
    exact,
    finite,
    relative,
)
from pp_cl.selftest.updated_points import Cloud, gradients
from pp_cl.training.loss import FURTHER, Loss, MaskLoss
from pp_cl.training.optim import adam_update, ema_update
from pp_cl.training.perceptual import PerceptualLoss
from pp_cl.training.smooth import Smoother
from pp_cl.training.state import split_opacity

LOSS = 16 * EPS  # 22 taps of a window, in two passes, and the sums of rows and columns
FLAT = 3e-6  # variances of nothing: rounding of Var[d] over C2 = 0.03^2
DEEP = 1e-5  # thirteen convolutions one after another, each within 3e-6


def _loss(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """L1 and SSIM; at sizes below a window L1 alone."""
    for size in ((11, 11), (12, 33), (33, 31), (40, 257), (1, 1), (1, 257), (10, 40)):
        prediction, target = _images(rng, *size)
        for weight, beta in ((0.2, 0.0), (1.0, 0.0), (0.1, 0.05)):
            yield from _loss_checks(dev, prediction, target, (weight, beta), LOSS)


def _images(rng, height, width):
    """A smooth target with texture, and a prediction that leaves [0, 1]."""
    y, x = np.mgrid[:height, :width][..., None] / 9.0
    noise = rng.standard_normal((2, height, width, 3))
    target = 0.5 + 0.4 * np.sin(x + y + np.arange(3)) * np.cos(2 * y) + 0.05 * noise[0]
    return (target + 0.1 * noise[1]).astype(np.float32), target.astype(np.float32)


def _loss_checks(dev, prediction, target, weights, *bounds):
    """weights: of 1 - SSIM, and beta. bounds: of the terms, and of the gradient where it is
    another.
    """
    loss = Loss(dev, *weights)
    grad = loss.forward_backward(dev.upload(prediction), dev.upload(target)).get()
    terms, expected = reference_loss.loss(prediction, target, *weights)
    yield each(loss.terms.get()[:4], terms, bounds[0], floor=1e-10 / bounds[0])
    yield relative(grad, expected, bounds[-1])


def _hard_loss(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Flat images, equal ones, and variances far below the squares they are the difference of."""
    for levels in ((0.0, 1.0), (1.0, 0.0), (1.0, 0.999), (0.3, 0.3001), (-2.0, 0.0)):
        prediction, target = (np.full((20, 30, 3), level, np.float32) for level in levels)
        yield from _loss_checks(dev, prediction, target, (0.2, 0.0), FLAT)
    for level in (0.0, 1.0):
        noise = 1e-3 * rng.standard_normal((2, 24, 35, 3))
        target = (level + noise[0]).astype(np.float32)
        prediction = (target + noise[1]).astype(np.float32)
        # rounding of values of 1 in variances of 1e-6, as shares of C2
        yield from _loss_checks(dev, prediction, target, (1.0, 0.0), 1e-5, 3e-5)
        yield from _equal_images(dev, target)


def _equal_images(dev, image):
    loss = Loss(dev, 0.2)
    grad = loss.forward_backward(dev.upload(image), dev.upload(image)).get()
    yield exact(loss.terms.get(), np.zeros(8))
    yield exact(grad, np.zeros_like(image))


def _mask_loss(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """weight * mean (alpha - mask)^2 of a part of the image, where alpha is too low times the
    shortfall's weight; nothing outside of it.
    """
    weight, shortfall, width, left, top = 0.7, 0.3, 29, 3, 1
    for side in SIZES:
        size, inside = (side + 3, 36), np.s_[top : top + side, left : left + width]
        transmittance, mask = rng.random(size), rng.random((side, width))
        squares, grad = MaskLoss(dev, weight).forward_backward(
            dev.upload(transmittance.ravel(), np.float32),
            dev.upload(mask, np.float32),
            size=size,
            offset=(left, top),
            shortfall=shortfall,
        )
        difference = 1 - transmittance[inside] - mask
        weighted = np.where(difference < 0, shortfall, 1) * difference
        sums = np.zeros(size[0])
        sums[top : top + side] = (weighted * difference).sum(axis=1)
        yield relative(squares.get(), sums, 8 * EPS)
        expected = np.zeros(size)
        expected[inside] = 2 * weight * weighted / mask.size
        yield relative(grad.get().reshape(size), expected, 8 * EPS)


def _sum_of_terms(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """The loss is that of the image and the weighted sums of all that is added."""
    prediction, target = _images(rng, 12, 33)
    for n in SIZES:
        loss, expected = Loss(dev, 0.2), np.zeros(8)
        expected[:4], _ = reference_loss.loss(prediction, target, 0.2)
        for _ in range(2):  # each time anew
            loss.forward_backward(dev.upload(prediction), dev.upload(target))
            for i, name in enumerate(FURTHER):
                values = rng.random(n).astype(np.float32)
                loss.add(name, dev.upload(values), 0.5 + i, scale=1 / n)
                expected[4 + i] = values.mean(dtype=np.float64)
        expected[0] += expected[4:7] @ (0.5, 1.5, 2.5)
        yield each(loss.terms.get(), expected, LOSS)


def _spread(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """sum_ij b_i b_j |z_i - z_j| of each pixel's hits; some have none, some lists end early."""
    for pixels in SIZES:
        lengths = rng.integers(0, 9, pixels)
        offset = np.concatenate([[0], np.cumsum(lengths)])
        b, z = rng.random((2, offset[-1])).astype(np.float32)
        order = np.lexsort((z, np.repeat(np.arange(pixels), lengths)))
        z = (100 + z[order]).astype(np.float32)
        entry = b.view(np.uint32).astype(np.uint64) << np.uint64(32)
        entry[rng.random(len(entry)) < 0.1] += np.uint64(2**32 - 1)
        ended = (entry & np.uint64(2**32 - 1)) > 0
        expected = []
        for first, end in itertools.pairwise(offset):
            stop = first + np.argmax(np.append(ended[first:end], True))
            weights, depths = b[first:stop].astype(np.float64), z[first:stop].astype(np.float64)
            expected.append(weights @ np.abs(depths[:, None] - depths) @ weights)
        spread = dev.empty((pixels,))
        dev.program("training/loss").launch(
            "loss_pixel_spread",
            pixels,
            hw=pixels,
            pixel_offset=dev.upload(offset, np.uint32),
            pair_key=dev.upload(z.view(np.uint32).astype(np.uint64) << np.uint64(32)),
            pixel_entry=dev.upload(entry),
            pixel_spread=spread,
        )
        yield absolute(spread.get(), expected, 64 * EPS)  # of up to 28 products below 1, twice


def _perceptual_loss(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    weights = random_weights(np.random.default_rng(5))
    for size in ((16, 16), (17, 33)):
        target = rng.uniform(0, 1, (*size, 3))
        prediction = target + rng.normal(0, 0.2, target.shape)
        loss = PerceptualLoss(dev, 0.3, make_policy(dev, variant="direct"), weights)
        images = [dev.upload(image, np.float32) for image in (prediction, target)]
        grad = dev.zeros(target.shape)
        distances = loss.add_gradient(*images, (0, 0), grad).get()
        given = [image.get().astype(np.float64) for image in images]
        yield relative(distances.sum(dtype=np.float64), lpips(*given, weights), DEEP)
        yield relative(grad.get(), 0.3 * lpips_gradient(*given, weights), DEEP)


def _adam(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Parameters and moments after twenty steps; the first step is the rate."""
    for n in SIZES:
        grads = 1e-3 * rng.standard_normal((20, n))
        for eps in (1e-8, 1e-15):
            twin, parameter, state = _adam_steps(
                dev, rng.standard_normal(n), grads, rate=0.01, eps=eps
            )
            # the parameter is rounded in each step, by half EPS of its size; rarely the same way
            yield relative(parameter, twin.parameter, 3e-7)
            yield each(state["m"].get(), twin.m, 8 * EPS, floor=1e-3)
            yield each(state["v"].get(), twin.v, 8 * EPS)
    _, parameter, _ = _adam_steps(dev, np.zeros(257), np.full((1, 257), -3e-4), rate=0.5, eps=1e-15)
    # what 1 - beta2 in float32 would miss by 7e-6
    yield each(parameter, np.full(257, 0.5), 4e-7)


def _adam_steps(dev, start, grads, *, rate, eps):
    """(float64 twin, parameter, moments) after a step with each gradient."""
    parameter = dev.upload(start, np.float32)
    twin, state = optim.Adam(parameter.get()), _moments(dev, parameter)
    for step, grad in enumerate(grads.astype(np.float32), 1):
        adam_update(dev, parameter, dev.upload(grad), state, step=step, rate=rate, eps=eps)
        twin.step(grad, rate, eps)
    return twin, parameter.get(), state


def _adam_extremes(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Gradients of 1e-20 to 1e10, of which float32 cannot square all; and of 0."""
    for scale in (1e-20, 1e-12, 1e-3, 1e10):
        for eps in (1e-8, 1e-15):
            grads = scale * rng.standard_normal((10, 31))
            twin, parameter, _ = _adam_steps(dev, np.zeros(31), grads, rate=0.1, eps=eps)
            # m / (sqrt(v) + eps): a few roundings, each step
            yield relative(parameter, twin.parameter, 1e-5)
    start = rng.standard_normal(33).astype(np.float32)
    _, parameter, state = _adam_steps(dev, start, np.zeros((3, 33)), rate=0.5, eps=1e-15)
    yield exact(parameter, start)
    yield exact(state["v"].get(), np.zeros(33))


def _moments(dev, parameter):
    return {kind: dev.zeros(parameter.shape) for kind in "mv"}


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


def _bounded_opacity(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Huge gradients keep it in [0, 1], at the values of float64."""
    opacity = dev.upload(rng.random(257), np.float32)
    twin, state = optim.Adam(opacity.get()), _moments(dev, opacity)
    for step in range(1, 21):
        drift = 1e4 * (rng.standard_normal(257) + np.linspace(-2, 2, 257))
        grad = dev.upload(drift, np.float32)
        adam_update(dev, opacity, grad, state, step=step, rate=0.03, eps=1e-15, bounded=True)
        twin.step(grad.get(), 0.03, 1e-15, low=0, high=1)
    moved = opacity.get()
    yield finite(moved)
    yield exact([moved.min(), moved.max()], [0, 1])
    yield absolute(moved, twin.parameter, 2e-6)  # twenty moves of 0.03


def _ema(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    for n in SIZES:
        old, new = rng.standard_normal((2, n)).astype(np.float32)
        ema = dev.upload(old)
        ema_update(dev, ema, dev.upload(new), 0.01)
        expected = old + 0.01 * (new.astype(np.float64) - old)
        yield relative(ema.get(), expected, 2 * EPS)


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
        opacity = np.float32(rng.uniform(0, 1, n))
        opacity[::5], opacity[1::5], opacity[2::5] = 0, 1, 1e-7
        array = dev.upload(opacity)
        split_opacity(dev, array)
        wide = opacity.astype(np.float64)
        yield each(array.get(), wide / (1 + np.sqrt(1 - wide)), 3e-7)


CASES = (
    Case("loss: L1 and SSIM", _loss),
    Case("loss: flat and equal images", _hard_loss),
    Case("loss: mask", _mask_loss),
    Case("loss: spread", _spread),
    Case("loss: sum of its terms", _sum_of_terms),
    Case("loss: perceptual", _perceptual_loss),
    Case("adam: arrays", _adam),
    Case("adam: gradients of 0, 1e-20 and 1e10", _adam_extremes),
    Case("adam: opacities at their bounds", _bounded_opacity),
    *(Case(f"rmsprop: degree {d}", partial(_rmsprop, d)) for d in SH_DEGREES),
    Case("rmsprop: gradients of 0, 1e-20, 1e10 and NaN", _rmsprop_extremes),
    Case("training: moving average", _ema),
    Case("training: smoothing", _smooth),
    Case("training: split opacities", _refine),
)
