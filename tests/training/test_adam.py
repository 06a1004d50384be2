"""cl/training/adam.cl against Adam in float64."""

import numpy as np
import pytest
from pp_cl.training.adam import Ema, adam_update, ema_update
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.reference import optim as oracle_optim


def moments(dev, parameter):
    """Adam's, of a parameter: zeros."""
    return {kind: dev.zeros(parameter.shape) for kind in "mv"}


def train(dev, start, grads, rate, eps):
    """(parameter, m, v) after a step with each gradient, and the oracle."""
    parameter = dev.upload(start)
    state = moments(dev, start)
    oracle = oracle_optim.Adam(start)
    for step, grad in enumerate(grads, 1):
        adam_update(dev, parameter, dev.upload(grad), state, step=step, rate=rate, eps=eps)
        oracle.step(grad, rate, eps)
    return parameter.get(), state["m"].get(), state["v"].get(), oracle


@pytest.mark.parametrize("n", [*AWKWARD_SIZES, 16])
@pytest.mark.parametrize("eps", [1e-8, 1e-15])
def test_matches_oracle(dev, rng, n, eps):
    start = rng.standard_normal(n).astype(np.float32)
    grads = 1e-3 * rng.standard_normal((20, n)).astype(np.float32)
    parameter, m, v, oracle = train(dev, start, grads, 0.01, eps)
    assert relative_error(parameter, oracle.parameter) < 3e-7
    np.testing.assert_allclose(m, oracle.m, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(v, oracle.v, rtol=1e-6)


def test_any_rank(dev, rng):
    start = rng.standard_normal((3, 5, 7)).astype(np.float32)
    grads = rng.standard_normal((2, 3, 5, 7)).astype(np.float32)
    parameter, _, _, oracle = train(dev, start, grads, 0.01, 1e-8)
    assert relative_error(parameter, oracle.parameter) < 3e-7


def test_first_step_is_the_rate(dev):
    """m^/sqrt(v^) of one gradient is its sign: what (1 - beta2) in float32 would miss by 7e-6."""
    start, grad = np.zeros(257, np.float32), np.full(257, -3e-4, np.float32)
    parameter, _, _, _ = train(dev, start, [grad], 0.5, 1e-15)
    np.testing.assert_allclose(parameter, 0.5, rtol=4e-7)


def test_many_steps_stay_with_float64(dev, rng):
    start = rng.standard_normal(33).astype(np.float32)
    slope = rng.standard_normal(33).astype(np.float32)
    grads = slope * (0.3 + rng.standard_normal((1000, 33)).astype(np.float32))
    parameter, _, _, oracle = train(dev, start, grads, 0.02, 1e-8)
    assert np.abs(oracle.parameter - start).max() > 1
    assert relative_error(parameter, oracle.parameter) < 1e-5


@pytest.mark.parametrize("scale", [1e-20, 1e-12, 1e-3, 1e10])
@pytest.mark.parametrize("eps", [1e-8, 1e-15])
def test_extreme_gradients(dev, rng, scale, eps):
    start = np.zeros(31, np.float32)
    grads = (scale * rng.standard_normal((10, 31))).astype(np.float32)
    parameter, _, _, oracle = train(dev, start, grads, 0.1, eps)
    assert relative_error(parameter, oracle.parameter) < 1e-5


def test_zero_gradient_moves_nothing_but_momentum_does(dev, rng):
    start = rng.standard_normal(33).astype(np.float32)
    zero = np.zeros_like(start)
    parameter, m, v, _ = train(dev, start, [zero] * 3, 0.5, 1e-15)
    np.testing.assert_array_equal(parameter, start)
    assert not m.any()
    assert not v.any()
    first = rng.standard_normal(33).astype(np.float32)
    parameter, _, _, oracle = train(dev, start, [first, zero, zero], 0.5, 1e-15)
    assert np.abs(oracle.parameter - start).min() > 0.8  # more than the one step of 0.5
    assert relative_error(parameter, oracle.parameter) < 1e-6


def test_refuses_different_shapes(dev):
    a, b = dev.zeros((4, 3)), dev.zeros((3, 4))
    with pytest.raises(ValueError, match="one shape"):
        adam_update(dev, a, b, moments(dev, a), step=1, rate=0.1, eps=1e-8)
    with pytest.raises(ValueError, match="one shape"):
        ema_update(dev, a, b, 0.5)


@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_opacity_stays_in_its_bounds(dev, rng, n):
    opacity = dev.upload(rng.random(n), np.float32)
    state, oracle = moments(dev, opacity), oracle_optim.Adam(opacity.get())
    for step in range(1, 41):
        grad = dev.upload(rng.standard_normal(n) + np.linspace(-2, 2, n), np.float32)
        adam_update(dev, opacity, grad, state, step=step, rate=0.03, eps=1e-15, bounded=True)
        oracle.step(grad.get(), 0.03, 1e-15, low=0, high=1)
    if n > 1:
        assert opacity.get().min() == 0
        assert opacity.get().max() == 1
    np.testing.assert_allclose(opacity.get(), oracle.parameter, atol=2e-6)


@pytest.mark.exact
def test_a_nan_is_not_hidden(dev):
    opacity, grad = dev.zeros((31,)), dev.upload(np.full(31, np.nan), np.float32)
    state = moments(dev, opacity)
    adam_update(dev, opacity, grad, state, step=1, rate=0.03, eps=1e-15, bounded=True)
    assert np.isnan(opacity.get()).all()


@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_average(dev, rng, n):
    average, parameter = rng.standard_normal((2, n)).astype(np.float32)
    on_device = dev.upload(average)
    ema_update(dev, on_device, dev.upload(parameter), 0.3)
    expected = 0.7 * average.astype(np.float64) + 0.3 * parameter
    assert relative_error(on_device.get(), expected) < 2e-7


def test_average_starts_as_a_copy(dev, rng):
    parameter = rng.standard_normal((31, 3)).astype(np.float32)
    average = dev.empty((31, 3))  # NaN
    ema_update(dev, average, dev.upload(parameter), 1.0)
    np.testing.assert_array_equal(average.get(), parameter)


def test_averages_are_applied_and_released(dev, rng):
    parameters = {name: dev.upload(rng.random(33), np.float32) for name in "ab"}
    start = {name: array.get() for name, array in parameters.items()}
    ema, before = Ema(dev), dev.bytes
    ema.update(parameters, 1.0)
    for array in parameters.values():
        dev.fill(array, 0)
    ema.update(parameters, 0.25)
    ema.apply(parameters)
    assert not ema.arrays and dev.bytes == before
    for name, array in parameters.items():
        np.testing.assert_allclose(array.get(), 0.75 * start[name], rtol=1e-6)
    dev.fill(parameters["a"], 0)
    ema.apply(parameters)
    assert not parameters["a"].get().any()
