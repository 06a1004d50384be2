"""cl/adam.cl against Adam in float64."""

import numpy as np
import oracle_optim
import pytest
from helpers import AWKWARD_SIZES, relative_error

from pp_cl.adam import adam_sh_update, adam_update, ema_update
from pp_cl.camera import Camera
from pp_cl.points import Grid

GRID = Grid((-0.7, -0.5, -0.6), 0.05, (23, 19, 31))
EYE = np.array([1.5, -2.5, 1.2])
CAMERA = Camera(np.column_stack([np.eye(3), EYE]), 100, 100, 50, 50, 100, 100)


def moments(dev, parameter):
    return dev.zeros(parameter.shape), dev.zeros(parameter.shape)


def train(dev, start, grads, rate, eps, **options):
    """(parameter, m, v) after a step with each gradient, and the oracle."""
    parameter = dev.upload(start)
    m, v = moments(dev, start)
    oracle = oracle_optim.Adam(start)
    for step, grad in enumerate(grads, 1):
        adam_update(dev, parameter, dev.upload(grad), m, v, step, rate, eps, **options)
        oracle.step(grad, rate, eps, **options)
    return parameter.get(), m.get(), v.get(), oracle


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


def test_clamp(dev, rng):
    start = rng.random(257).astype(np.float32)
    grads = rng.standard_normal((30, 257)).astype(np.float32)
    parameter, _, _, oracle = train(dev, start, grads, 0.2, 1e-15, low=0, high=1)
    assert parameter.min() == 0
    assert parameter.max() == 1
    np.testing.assert_allclose(parameter, oracle.parameter, atol=2e-6)


def test_other_betas(dev, rng):
    start, grads = rng.standard_normal(33).astype(np.float32), rng.standard_normal((5, 33)).astype(np.float32)
    parameter, (m, v), oracle = dev.upload(start), moments(dev, start), oracle_optim.Adam(start, 0.5, 0.9)
    for step, grad in enumerate(grads, 1):
        adam_update(dev, parameter, dev.upload(grad), m, v, step, 0.1, 1e-8, beta1=0.5, beta2=0.9)
        oracle.step(grad, 0.1, 1e-8)
    assert relative_error(parameter.get(), oracle.parameter) < 3e-7


def test_refuses_different_shapes(dev):
    a, b = dev.zeros((4, 3)), dev.zeros((3, 4))
    with pytest.raises(ValueError, match="one shape"):
        adam_update(dev, a, b, dev.zeros((4, 3)), dev.zeros((4, 3)), 1, 0.1, 1e-8)
    with pytest.raises(ValueError, match="one shape"):
        ema_update(dev, a, b, 0.5)


def cloud(rng, n, degree):
    """ids, a gradient a step (every third point unseen), start coefficients."""
    ids = np.sort(rng.choice(np.prod(GRID.dims), n, replace=False)).astype(np.uint32)
    grads = 1e-4 * rng.standard_normal((4, n, 16)).astype(np.float32)
    grads[:, ::3] = 0
    return ids, grads, rng.standard_normal((n, 2 * degree + 1, 16)).astype(np.float32)


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_sh_is_dense_adam(dev, rng, n, degree):
    ids, grads, start = cloud(rng, n, degree)
    sh, (m, v), oracle = dev.upload(start), moments(dev, start), oracle_optim.Adam(start)
    device_ids, grid, camera = dev.upload(ids), dev.upload(GRID.packed()), dev.upload(CAMERA.packed())
    for step, grad in enumerate(grads, 1):
        adam_sh_update(dev, grid, camera, device_ids, dev.upload(grad), sh, m, v, step, 0.1, 4e-7)
        oracle.step(oracle_optim.sh_gradient(GRID.positions(ids), EYE, grad, degree), 0.1, 4e-7)
    assert relative_error(sh.get(), oracle.parameter) < 1e-6
    np.testing.assert_array_equal(sh.get()[::3], start[::3])
    if n > 1:
        assert relative_error(m.get(), oracle.m) < 1e-6
        assert relative_error(v.get(), oracle.v) < 2e-6


def test_sh_refuses_a_mix_of_degrees(dev):
    arrays = [dev.zeros((2, 4, 16)) for _ in range(3)]
    with pytest.raises(ValueError, match="one degree"):
        adam_sh_update(dev, dev.zeros((8,)), dev.zeros((20,)), dev.zeros((2,), np.uint32), dev.zeros((2, 16)), *arrays,
                       step=1, rate=0.1, eps=0)


def test_sh_of_a_point_in_the_eye_stays_finite(dev):
    """No pixel sees it, so its gradient is 0; its direction is undefined."""
    grid, camera = Grid((0, 0, 0), 0.5, (5, 5, 5)), Camera(np.column_stack([np.eye(3), [1.0, 0.5, 0]]), 9, 9, 4, 4, 8, 8)
    ids = np.array([2 + 5, 3], np.uint32)
    start = np.ones((2, 5, 16), np.float32)
    sh, (m, v) = dev.upload(start), moments(dev, start)
    adam_sh_update(dev, dev.upload(grid.packed()), dev.upload(camera.packed()), dev.upload(ids), dev.zeros((2, 16)),
                   sh, m, v, 1, 0.5, 1e-15)
    np.testing.assert_array_equal(sh.get(), start)
    assert not m.get().any()


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
