"""cl/training/loss.cl against its float64 twin, scikit-image and finite differences."""

import numpy as np
import pytest
from skimage.metrics import structural_similarity
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.reference import loss as oracle_loss
from pp_cl.reference.differences import numeric_gradient
from pp_cl.training.loss import Loss

SIZES = [(11, 11), (12, 33), (31, 16), (33, 31), (40, 257)]


def images(rng, height, width, noise=0.1):
    """A smooth target with texture, and a prediction that leaves [0, 1]."""
    y, x = np.mgrid[:height, :width][..., None] / 9.0
    target = (
        0.5
        + 0.4 * np.sin(x + y + np.arange(3)) * np.cos(2 * y)
        + 0.05 * rng.standard_normal((height, width, 3))
    )
    prediction = target + noise * rng.standard_normal(target.shape)
    return prediction.astype(np.float32), target.astype(np.float32)


def run(dev, prediction, target, weight, beta=0.0, **offset):
    loss = Loss(dev, weight, beta)
    grad = loss.forward_backward(dev.upload(prediction), dev.upload(target), **offset)
    return loss.terms.get(), grad.get()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("weight, beta", [(0.2, 0.0), (1.0, 0.0), (0.1, 0.05), (0.2, 1.0)])
def test_matches_oracle(dev, rng, size, weight, beta):
    prediction, target = images(rng, *size)
    terms, grad = run(dev, prediction, target, weight, beta)
    expected_terms, expected_grad = oracle_loss.loss(prediction, target, weight, beta)
    np.testing.assert_allclose(terms, expected_terms, rtol=2e-6)
    assert relative_error(grad, expected_grad) < 2e-6


@pytest.mark.parametrize("beta", [0.0, 0.05])
def test_oracle_gradient_is_the_derivative(rng, beta):
    prediction, target = images(rng, 14, 13)
    assert np.abs(prediction - target).min() > 1e-6  # else L1 has a kink inside the difference
    _, grad = oracle_loss.loss(prediction, target, 0.7, beta)
    numeric = numeric_gradient(
        lambda p: oracle_loss.loss(p, target, 0.7, beta)[0][0], prediction, 5e-7
    )
    assert relative_error(grad.ravel(), numeric) < 1e-6


@pytest.mark.parametrize("weight", [0.0, 0.1])
def test_a_nan_is_not_hidden(dev, rng, weight):
    prediction, target = images(rng, 14, 13)
    prediction[5, 6, 1] = np.nan
    terms, grad = run(dev, prediction, target, weight, 0.05)
    assert np.isnan(terms[0]) and np.isnan(grad[5, 6, 1])


def test_smooth_l1_is_torchs(rng):
    """torch.nn.SmoothL1Loss(beta=0.05) of these errors."""
    error = np.array([0.0, 0.01, -0.05, 0.3]).reshape(1, 4, 1).repeat(3, axis=2)
    terms, grad = oracle_loss.loss(error, np.zeros_like(error), 0.0, 0.05)
    assert terms[0] == pytest.approx((0.001 + 0.025 + 0.275) / 4)
    np.testing.assert_allclose(12 * grad[0, :, 0], [0, 0.2, -1, 1])


def test_ssim_is_scikit_images(dev, rng):
    prediction, target = images(rng, 37, 64)
    terms, _ = run(dev, prediction, target, 0.2)
    expected = structural_similarity(
        prediction.astype(np.float64),
        target.astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    assert terms[2] == pytest.approx(1 - expected, rel=2e-6)


@pytest.mark.parametrize(
    ("size", "weight"),
    [((10, 40), 0.2), ((40, 10), 0.2), ((1, 1), 0.2), ((1, 257), 0.2), ((33, 31), 0.0)],
)
def test_without_ssim(dev, rng, size, weight):
    prediction, target = images(rng, *size)
    terms, grad = run(dev, prediction, target, weight)
    expected_terms, expected_grad = oracle_loss.loss(prediction, target, weight)
    np.testing.assert_allclose(terms, expected_terms, rtol=2e-6)
    assert terms[2] == 0
    np.testing.assert_allclose(grad, expected_grad, rtol=1e-6)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_equal_images_have_no_loss_and_no_gradient(dev, rng, level):
    for target in (np.full((20, 30, 3), level, np.float32), images(rng, 20, 30)[1]):
        terms, grad = run(dev, target, target, 0.2)
        assert not terms.any()
        assert not grad.any()


@pytest.mark.parametrize(
    "levels", [(0.0, 1.0), (1.0, 0.0), (1.0, 0.999), (0.3, 0.3001), (-2.0, 0.0)]
)
def test_flat_images(dev, levels):
    prediction, target = (np.full((20, 30, 3), level, np.float32) for level in levels)
    terms, grad = run(dev, prediction, target, 0.2)
    expected_terms, expected_grad = oracle_loss.loss(prediction, target, 0.2)
    # 1 - SSIM: rounding of Var[d] over C2
    np.testing.assert_allclose(terms, expected_terms, rtol=3e-6, atol=1e-10)
    assert relative_error(grad, expected_grad) < 3e-6


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_almost_flat_images(dev, rng, level):
    """Variances far below the squares they are the difference of: the textbook form in float32 is
    off by 2e-3 at level 1.
    """
    target = level + 1e-3 * rng.standard_normal((24, 35, 3))
    prediction = target + 1e-3 * rng.standard_normal(target.shape)
    prediction, target = prediction.astype(np.float32), target.astype(np.float32)
    terms, grad = run(dev, prediction, target, 1.0)
    expected_terms, expected_grad = oracle_loss.loss(prediction, target, 1.0)
    np.testing.assert_allclose(terms, expected_terms, rtol=1e-5)
    assert relative_error(grad, expected_grad) < 3e-5


@pytest.mark.parametrize(("left", "top"), [(0, 0), (1, 2), (3, 1)])
def test_target_inside_a_larger_prediction(dev, rng, left, top):
    prediction, target = images(rng, 22, 29)
    expected_terms, expected_grad = run(dev, prediction, target, 0.2)
    padded = np.full((24, 32, 3), np.nan, np.float32)  # poison: nothing outside may be read
    inner = np.s_[top : top + 22, left : left + 29]
    padded[inner] = prediction
    terms, grad = run(dev, padded, target, 0.2, left=left, top=top)
    np.testing.assert_array_equal(terms, expected_terms)
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
        grad = loss.forward_backward(dev.upload(prediction), dev.upload(target))
        expected_terms, expected_grad = oracle_loss.loss(prediction, target, 0.2)
        np.testing.assert_allclose(loss.terms.get(), expected_terms, rtol=2e-6)
        assert relative_error(grad.get(), expected_grad) < 2e-6


def test_same_bits_twice(dev, rng):
    prediction, target = images(rng, 64, 80)
    first, second = run(dev, prediction, target, 0.2), run(dev, prediction, target, 0.2)
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1].tobytes() == second[1].tobytes()


def float32_sum(terms, group):
    """(4,) of terms (M, 4) in float32: member by member of a group, then as a tree."""
    sums = np.zeros((group, 4), np.float32)
    for first in range(0, len(terms), group):
        part = terms[first : first + group]
        sums[: len(part)] += part
    while len(sums) > 1:
        sums = sums[: len(sums) // 2] + sums[len(sums) // 2 :]
    return sums[0]


@pytest.mark.parametrize("m", [*AWKWARD_SIZES, 1590])
@pytest.mark.parametrize("group", [1, 2, 256])
def test_terms_are_summed_in_a_fixed_order(dev, rng, m, group):
    terms = rng.uniform(0, 1, (3, m, 4)).astype(np.float32)
    sums = dev.empty((3, 4))
    dev.program("training/loss", GROUP=group).launch(
        "loss_sum", 3 * group, group, rows=3, m=m, terms=dev.upload(terms), sums=sums
    )
    assert np.array_equal(sums.get(), [float32_sum(row, group) for row in terms])


def test_a_tree_is_more_exact(rng):
    """Than one work-item that sums them all."""
    terms = rng.uniform(0, 1, (1590, 4)).astype(np.float32)
    exact = terms.sum(axis=0, dtype=np.float64)
    serial, tree = (np.abs(float32_sum(terms, group) - exact).max() for group in (1, 256))
    assert 5 * tree < serial
