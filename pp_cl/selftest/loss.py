"""Cases of the losses: L1 and SSIM, masks, exposure, and their sum."""

from functools import partial

import numpy as np

from pp_cl.engine.training.exposure import DECAY, PRIOR, Exposure
from pp_cl.engine.training.ignored import ignore_gradient, ignore_target
from pp_cl.engine.training.loss import Loss
from pp_cl.reference import loss as reference_loss
from pp_cl.selftest.case import EPS, SIZES, Case, each, exact, relative

LOSS = 16 * EPS  # 22 taps of a window, in two passes, and the sums of rows and columns
ONE = np.uint8(1)
FULL = 2e-5  # for matrices: normal equations with a condition of some hundred, in float32
FLAT = 3e-6  # for variances of 0: rounding of Var[d] divided by C2 = 0.03^2


def _loss(dev, rng):
    """L1 and SSIM; images smaller than a window have L1 alone."""
    for size in ((11, 11), (12, 33), (33, 31), (40, 257), (1, 1), (1, 257), (10, 40)):
        prediction, target = images(rng, *size)
        for weight, beta in ((0.2, 0.0), (1.0, 0.0), (0.1, 0.05)):
            yield from _loss_checks(dev, prediction, target, (weight, beta), LOSS)


def images(rng: np.random.Generator, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A smooth target with texture, and a prediction that leaves [0, 1]."""
    y, x = np.mgrid[:height, :width][..., None] / 9.0
    noise = rng.standard_normal((2, height, width, 3))
    target = 0.5 + 0.4 * np.sin(x + y + np.arange(3)) * np.cos(2 * y) + 0.05 * noise[0]
    return (target + 0.1 * noise[1]).astype(np.float32), target.astype(np.float32)


def _loss_checks(dev, prediction, target, weights, *bounds, is_hard=False):
    """Checks of the loss's terms and gradient. weights: the weight of 1 - SSIM, and beta."""
    loss, images = Loss(dev, *weights), (prediction, target)
    grad, _ = loss.forward_backward(*map(dev.upload, images))
    terms, expected = reference_loss.loss(*images, *weights)
    textbook = reference_loss.loss(*images, *weights, dtype=np.float32) if is_hard else (None,) * 2
    yield each(four_terms(loss), terms, bounds[0], floor=1e-10 / bounds[0], naive=textbook[0])
    yield relative(grad.get(), expected, bounds[-1], naive=textbook[1])


def four_terms(loss: Loss) -> np.ndarray:
    """(4,) terms of the last image: L, L1, 1 - SSIM and the mean squared error."""
    losses = loss.read(1).get()
    mse = 10 ** (-losses["psnr"] / 10)
    return np.array([losses["loss"], losses["l1"], 1 - losses["ssim"], mse])


def _flat(dev, rng):
    """Flat images, and variances far smaller than the squares whose difference they are."""
    for levels in ((0.0, 1.0), (1.0, 0.0), (1.0, 0.999), (0.3, 0.3001), (-2.0, 0.0)):
        prediction, target = (np.full((20, 30, 3), level, np.float32) for level in levels)
        yield from _loss_checks(dev, prediction, target, (0.2, 0.0), FLAT, is_hard=True)
    for level in (0.0, 1.0):
        target = (level + 1e-3 * rng.standard_normal((24, 35, 3))).astype(np.float32)
        prediction = (target + 1e-3 * rng.standard_normal(target.shape)).astype(np.float32)
        # rounding of values of 1 in variances of 1e-6, as shares of C2
        yield from _loss_checks(dev, prediction, target, (1.0, 0.0), 1e-5, 3e-5, is_hard=True)


def _equal(dev, rng):
    for level in (0.0, 1.0):
        target = (level + 1e-3 * rng.standard_normal((24, 35, 3))).astype(np.float32)
        loss, difference = Loss(dev, 0.2), target - target
        grad, _ = loss.forward_backward(dev.upload(target), dev.upload(target))
        yield exact(four_terms(loss)[:3], np.zeros(3))
        naive = difference / np.abs(difference)
        yield exact(grad.get(), np.zeros_like(target), naive=naive)


def _millions(dev, rng):
    """The mean of 4 million values."""
    target = (0.1 + 1e-3 * rng.random((1024, 1366, 3))).astype(np.float32)
    loss, mean = Loss(dev, 0.0), target.mean(dtype=np.float64)
    loss.forward_backward(dev.zeros(target.shape), dev.upload(target))
    naive = target.ravel().cumsum()[-1:] / np.float32(target.size)
    yield each([loss.read(1).get()["l1"]], [mean], LOSS, naive=naive)


def _mask_loss(dev, rng):
    """The mask loss of a part of the image, times the shortfall's weight where alpha is too low; no
    loss outside.
    """
    weight, shortfall, width, left, top = 0.7, 0.3, 29, 3, 1
    for side in SIZES:
        size, inside = (side + 3, 36), np.s_[top : top + side, left : left + width]
        transmittance, mask = rng.random(size), rng.random((side, width))
        ignored = rng.random(mask.shape) < 0.2
        loss = Loss(dev, 0.0, mask_weight=weight)
        rendered = dev.upload(transmittance.ravel(), np.float32)
        images = dev.zeros((*size, 3)), dev.zeros((side, width, 3))
        alphas = rendered, dev.upload(np.where(ignored, -1, mask), np.float32)
        _, grad = loss.forward_backward(*images, left, top, alphas=alphas, shortfall=shortfall)
        difference = np.where(ignored, 0, 1 - transmittance[inside] - mask)
        weighted = np.where(difference < 0, shortfall, 1) * difference
        losses, mean = loss.read(1).get(), (weighted * difference).mean()
        yield each([losses["loss"], losses["mask"]], [weight * mean, mean], 8 * EPS)
        expected = np.zeros(size)
        expected[inside] = 2 * weight * weighted / mask.size
        yield relative(grad.get().reshape(size), expected, 8 * EPS)


def _ignored(dev, rng):
    """Ignored pixels of a part of an image: the target there, and no gradient."""
    for side in SIZES:
        prediction, target = images(rng, side + 3, 36)[0], images(rng, side, 29)[1]
        inside, offset = np.s_[1 : 1 + side, 3:32], (3, 1)
        ignored, alpha = rng.random((2, side, 29)).astype(np.float32)
        ignored = ignored < 0.3
        shown, wanted, mask, where = map(dev.upload, (prediction, target, alpha, ignored * ONE))
        ignore_target(dev, where, shown, wanted, mask, offset)
        filled = np.where(ignored[..., None], prediction[inside], target)
        yield exact(wanted.get(), filled)
        yield exact(mask.get(), np.where(ignored, -1, alpha))
        grad = dev.upload(prediction)
        ignore_gradient(dev, where, grad, offset)
        expected = prediction.copy()
        expected[inside][ignored] = 0
        yield exact(grad.get(), expected)


def _sum_of_terms(dev, rng):
    """The loss is the image's loss plus the added terms."""
    for n in SIZES:
        prediction, target = images(rng, 12, n)
        loss, (terms, _) = Loss(dev, 0.2), reference_loss.loss(prediction, target, 0.2)
        for _ in range(2):  # the second sum must not contain the first
            loss.forward_backward(dev.upload(prediction), dev.upload(target))
            values = rng.random(12 * n).astype(np.float32)
            losses = loss.read(1, dev.upload(values), 1.5, scale=1 / n).get()
            added = values.sum(dtype=np.float64) / n
        expected = [terms[0] + 1.5 * added, added]
        yield each([losses["loss"], losses["distortion"]], expected, LOSS)


def _exposure(dev, rng, is_full):
    """The matrices of three views, one of them seen twice and one never, and images corrected with
    them.
    """
    sums, left, top = np.zeros((3, 2, 8, 4)), 3, 1
    exposure = Exposure(dev, 3, is_applied=True)
    exposure.is_full = is_full
    for view, side in zip((0, 2, 0), (1, 33, 257), strict=True):
        alpha = rng.random((side, 29))
        prediction = rng.random((side + 3, 36, 3))
        white = 1 - alpha[..., None]
        rendered = prediction[top : top + side, left : left + 29] - white
        turned = rendered @ (np.eye(3) + 0.2 * rng.normal(size=(3, 3))).T
        image = turned + 0.1 * rng.random(3) * alpha[..., None]
        arrays = (prediction, image + white, alpha)
        shown_as, shot, mask = (dev.upload(array, np.float32) for array in arrays)
        matrix = exposure.state.get()[view, 16:].astype(np.float64)
        expected = (image - alpha[..., None] * matrix[:, 3]) @ np.linalg.inv(matrix[:, :3]).T
        yield relative(exposure.target(view, shot, mask).get(), expected + white, 32 * EPS)
        exposure.fit(view, shown_as, shot, mask, (left, top))
        y, x = np.mgrid[:side, :29] // 8
        sums[view] *= DECAY
        for half in range(2):
            a = np.where((x + y) % 2 == half, alpha, 0)
            p = np.concatenate([rendered, alpha[..., None]], -1)
            sums[view, half, :4] += np.einsum("yx,yxi,yxj->ij", a, p, p)
            sums[view, half, 4:7] += np.einsum("yx,yxi,yxj->ij", a, image, p)
            sums[view, half, 7, :3] += np.einsum("yx,yxi->i", a, image**2)
        yield relative(exposure.state.get()[:, :16].reshape(sums.shape), sums, 16 * EPS)
        expected = _matrices(sums.sum(1), PRIOR * alpha.size, is_full)
        matrices = exposure.state.get()[:, 16:]
        yield relative(matrices, expected, FULL if is_full else 32 * EPS)
        if not is_full:
            gains, rgb = sums.sum(1).astype(np.float32), range(3)
            naive = gains[:, [4, 5, 6], rgb] / gains[:, rgb, rgb]
            yield relative(
                matrices[:, rgb, rgb], expected[:, rgb, rgb], 32 * EPS, naive=naive / naive.mean(0)
            )


def _matrices(sums, prior, is_full):
    """(views, 3, 4) matrices from sums (views, 8, 4), relative to their mean."""
    squares, mixed = sums[:, :4] + prior * np.eye(4), sums[:, 4:7] + prior * np.eye(3, 4)
    if not is_full:
        squares, mixed = squares * np.eye(4), mixed * np.eye(3, 4)
    matrices = np.linalg.solve(squares, mixed.swapaxes(1, 2)).swapaxes(1, 2)
    square = np.concatenate([matrices, np.tile([[[0.0, 0, 0, 1]]], (len(sums), 1, 1))], 1)
    return (square @ np.linalg.inv(square.mean(0)))[:, :3]


CASES = (
    Case("loss: L1 and SSIM", _loss),
    Case("loss: flat images", _flat, hard="E[x^2] - E[x]^2 cancels"),
    Case("loss: equal images", _equal, hard="d / abs(d) is 0 / 0"),
    Case("loss: 4 million values", _millions, hard="added one by one"),
    Case("loss: mask", _mask_loss),
    Case("loss: ignored pixels", _ignored),
    Case(
        "loss: exposure",
        partial(_exposure, is_full=False),
        hard="gains of unseen views are 0 / 0",
    ),
    Case("loss: colours of a view", partial(_exposure, is_full=True)),
    Case("loss: sum of its terms", _sum_of_terms),
)
