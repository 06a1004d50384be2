"""cl/training/rmsprop.cl against RMSprop in float64."""

import numpy as np
import pytest
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.raster.points import SH_DEGREES
from pp_cl.reference import optim
from pp_cl.selftest.updated_points import Cloud, gradients


def check(cloud):
    """Compare coefficients and second moments with the oracle's."""
    assert relative_error(cloud.coefficients(), cloud.twin.sh) < 1e-6
    assert relative_error(cloud.second_moment(), cloud.twin.v) < 3e-6


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("degree", SH_DEGREES)
def test_matches_oracle(dev, rng, n, degree):
    """The oracle moves all points in all steps, also those that the image does not show."""
    cloud, last = Cloud(dev, rng, n, degree), np.zeros(n)
    for step in range(1, 13):
        grad, shaded = gradients(rng, n), np.flatnonzero(rng.random(n) < 0.4)
        cloud.step(grad, shaded)
        last[shaded[grad[shaded].any(axis=1)]] = step
    check(cloud)
    np.testing.assert_array_equal(cloud.moment.last_step.get(), last)


def test_it_is_adam_without_a_first_moment_on_the_average_over_directions(rng):
    """Of the oracle: for one gradient seen from everywhere, v is the mean of those that Adam keeps
    of the coefficients, and the moves are Adam's with that mean.
    """
    directions = rng.standard_normal((20_000, 3))
    basis = optim.basis(directions, np.zeros(3))
    grad = 1e-4 * np.ones((len(basis), 16))
    twin = optim.RmsProp(np.zeros((len(basis), 9, 16)), basis)
    adam = optim.Adam(np.zeros((len(basis), 9, 16)), beta1=0.0)
    twin.step(1, grad, np.ones(9), 0.0)
    adam.step(basis[:, :, None] * grad[:, None], 1.0, 0.0)
    np.testing.assert_allclose(adam.v[:, :, 0].mean(axis=0), twin.v[0, 0], rtol=0.03)
    for degree in SH_DEGREES:
        of_degree = adam.v[:, degree**2 : (degree + 1) ** 2, 0].mean(axis=1)
        np.testing.assert_allclose(of_degree, twin.v[:, 0], rtol=1e-9)  # in every direction
    shared = np.sqrt(adam.v / twin.v[:, None])
    np.testing.assert_allclose(adam.parameter * shared, twin.sh, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("step", [100, 3000, 50_000, 10**8])
def test_many_skipped_steps(dev, rng, step):
    cloud = Cloud(dev, rng, 33)
    for at in (1, step, step + 1):
        cloud.step(gradients(rng, 33), np.arange(33), at)
    check(cloud)


def test_points_without_a_gradient_keep_their_values(dev, rng):
    cloud, shaded = Cloud(dev, rng, 257), np.arange(0, 257, 2)
    for _ in range(2):
        before = cloud.coefficients(), *(array.get() for array in cloud.moment)
        cloud.step(gradients(rng, 257), shaded)
        after = cloud.coefficients(), *(array.get() for array in cloud.moment)
        moved = np.isin(np.arange(257), shaded) & (np.arange(257) % 3 > 0)
        for new, old in zip(after, before, strict=True):
            np.testing.assert_array_equal(new[~moved], old[~moved])
            assert (new[moved] != old[moved]).any()
    cloud.step(gradients(rng, 257), np.array([], int))
    np.testing.assert_array_equal(cloud.coefficients(), after[0])


@pytest.mark.parametrize("rates", [(0.1, 0, 0), (0.1, 0.05, 0), (0, 0.05, 0.02), (0, 0, 0)])
def test_degrees_at_rate_0_stay(dev, rng, rates):
    cloud = Cloud(dev, rng, 31)
    for _ in range(3):
        cloud.step(gradients(rng, 31), np.arange(31), rates=rates)
    found = cloud.coefficients()
    assert relative_error(found, cloud.twin.sh) < 1e-6
    for degree, rate in enumerate(rates):
        part = np.s_[:, degree**2 : (degree + 1) ** 2]
        assert (found[part] == cloud.start[part]).all() == (rate == 0)


@pytest.mark.parametrize("scale", [1e-20, 1e-12, 1e-3, 1e10])
def test_extreme_gradients(dev, rng, scale):
    cloud = Cloud(dev, rng, 31)
    for _ in range(10):
        cloud.step(scale / 1e-4 * gradients(rng, 31), np.arange(31))
    assert relative_error(cloud.coefficients(), cloud.twin.sh) < 1e-6


@pytest.mark.exact
def test_a_nan_is_not_hidden(dev, rng):
    cloud, grad = Cloud(dev, rng, 31), np.zeros((31, 16))
    grad[3, 7] = np.nan
    cloud.step(grad, np.arange(31))
    nan = np.isnan(cloud.coefficients())
    assert nan[3, :, 7].all() and nan.sum() == 9
    assert cloud.moment.last_step.get()[3] == 1


def test_many_steps_stay_with_float64(dev, rng):
    cloud = Cloud(dev, rng, 33)
    slope = rng.standard_normal((33, 16))
    for _ in range(1000):
        cloud.step(1e-4 * (slope * (0.3 + rng.standard_normal((33, 16)))), np.arange(33))
    assert np.abs(cloud.twin.sh - cloud.start).max() > 1
    assert relative_error(cloud.coefficients(), cloud.twin.sh) < 1e-5


def test_the_first_step_is_the_rate_times_the_harmonic(dev, rng):
    """G / sqrt(G^2 / (4 pi)) is the square root of 4 pi: degree 0 moves by the rate."""
    cloud = Cloud(dev, rng, 257)
    cloud.step(np.full((257, 16), -3.0), np.arange(257), rates=(0.5, 0, 0))
    moved = cloud.coefficients()[:, 0] - cloud.start[:, 0]
    np.testing.assert_allclose(moved, 0.5, rtol=2e-6)
