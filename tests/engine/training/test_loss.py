"""Compare the loss with scikit-image and finite differences; the selftest does with float64."""

import numpy as np
import pytest
from skimage.metrics import structural_similarity
from support.comparisons import relative_error

from pp_cl.engine.training.loss import Loss
from pp_cl.errors import Diverged
from pp_cl.reference import loss as oracle_loss
from pp_cl.reference.differences import numeric_gradient
from pp_cl.selftest.loss import four_terms, images


def run(dev, prediction, target, weight, beta=0.0, **offset):
    loss = Loss(dev, weight, beta)
    grad, _ = loss.forward_backward(dev.upload(prediction), dev.upload(target), **offset)
    return loss, grad.get()


@pytest.mark.parametrize("beta", [0.0, 0.05])
def test_oracle_gradient_is_the_derivative(rng, beta):
    prediction, target = images(rng, 14, 13)
    assert np.abs(prediction - target).min() > 1e-6  # else L1 has a kink inside the difference
    _, grad = oracle_loss.loss(prediction, target, 0.7, beta)
    indices = range(0, prediction.size, 5)  # in all rows, columns and colours
    numeric = numeric_gradient(
        lambda p: oracle_loss.loss(p, target, 0.7, beta)[0][0], prediction, 5e-7, indices
    )
    assert relative_error(grad.ravel()[indices], numeric) < 1e-6


@pytest.mark.parametrize("weight", [0.0, 0.1])
def test_a_nan_is_not_hidden(dev, rng, weight):
    prediction, target = images(rng, 14, 13)
    prediction[5, 6, 1] = np.nan
    loss, grad = run(dev, prediction, target, weight, 0.05)
    assert np.isnan(grad[5, 6, 1])
    pending = loss.read(7)
    for _ in range(2):  # each get() raises
        with pytest.raises(Diverged, match=r"at step 7 \(loss, l1(, ssim)?, psnr\)$"):
            pending.get()


def test_ssim_is_scikit_images(dev, rng):
    prediction, target = images(rng, 37, 64)
    loss, _ = run(dev, prediction, target, 0.2)
    expected = structural_similarity(
        prediction.astype(np.float64),
        target.astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    assert 1 - loss.read(1).get()["ssim"] == pytest.approx(1 - expected, rel=2e-6)


@pytest.mark.parametrize(("left", "top"), [(0, 0), (1, 2), (3, 1)])
def test_target_inside_a_larger_prediction(dev, rng, left, top):
    prediction, target = images(rng, 22, 29)
    expected, expected_grad = run(dev, prediction, target, 0.2)
    padded = np.full((24, 32, 3), np.nan, np.float32)  # poison: nothing outside may be read
    inner = np.s_[top : top + 22, left : left + 29]
    padded[inner] = prediction
    loss, grad = run(dev, padded, target, 0.2, left=left, top=top)
    assert loss.read(1).get() == expected.read(1).get()
    np.testing.assert_array_equal(grad[inner], expected_grad)
    grad[inner] = 0
    assert not grad.any()


@pytest.mark.parametrize(("left", "top"), [(4, 0), (0, 3), (-1, 0)])
def test_refuses_a_target_outside(dev, left, top):
    with pytest.raises(ValueError, match="reaches outside"):
        Loss(dev, 0.2).forward_backward(
            dev.zeros((24, 32, 3)), dev.zeros((22, 29, 3)), left=left, top=top
        )


def test_sizes_may_change_between_calls(dev, rng):
    loss = Loss(dev, 0.2)
    for size in [(20, 30), (10, 5), (31, 17), (20, 30)]:
        prediction, target = images(rng, *size)
        grad, _ = loss.forward_backward(dev.upload(prediction), dev.upload(target))
        expected_terms, expected_grad = oracle_loss.loss(prediction, target, 0.2)
        np.testing.assert_allclose(four_terms(loss), expected_terms, rtol=2e-6, atol=1e-15)
        assert relative_error(grad.get(), expected_grad) < 2e-6


def test_an_overflow_is_told_where_the_loss_is_finite(dev):
    """The square of 1e30 overflows, its absolute value does not."""
    loss = Loss(dev, 0.0)
    loss.forward_backward(dev.upload(np.full((3, 3, 3), 1e30), np.float32), dev.zeros((3, 3, 3)))
    with pytest.raises(Diverged, match=r"at step 2 \(psnr\)$"):
        loss.read(2).get()
