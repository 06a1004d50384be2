"""cl/training/adam.cl against Adam in float64."""

import numpy as np
import pyopencl as cl
import pytest
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.device.device import kernel_folder
from pp_cl.raster.sh import SH_BLOCKS
from pp_cl.reference import optim as oracle_optim
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.selftest.adam_points import EYE, GRID, SH_EPS, Cloud, gradients, moments, sh_moments
from pp_cl.training.adam import (
    Directions,
    Ema,
    PointAdam,
    PointsWithGradient,
    ShGradient,
    adam_update,
    ema_update,
    moment_scale,
)


def check(cloud):
    """Compare parameters and moments with the oracle's."""
    for actual, expected, bound in cloud.compared():
        assert relative_error(actual, expected) < bound


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
@pytest.mark.parametrize("block", SH_BLOCKS, ids=lambda b: b.name)
def test_dense_and_lazy_are_one_where_every_point_has_a_gradient(dev, n, block):
    states = []
    for lazy in (False, True):
        rng = np.random.default_rng(3)
        cloud = Cloud(dev, rng, n, block, lazy=lazy)
        for _ in range(5):
            cloud.step(*gradients(rng, n), np.arange(n))
        check(cloud)
        np.testing.assert_array_equal(cloud.sh.get()[::3], cloud.start["sh"][::3])
        states.append(cloud.state())
    assert (cloud.last_step.get() == 5).all()
    for name in states[0]:
        for dense, lazy in zip(states[0][name], states[1][name], strict=True):
            np.testing.assert_array_equal(dense, lazy)


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("block", SH_BLOCKS, ids=lambda b: b.name)
def test_lazy_matches_oracle(dev, rng, n, block):
    cloud = Cloud(dev, rng, n, block)
    for _ in range(12):
        cloud.step(*gradients(rng, n), np.flatnonzero(rng.random(n) < 0.4))
    check(cloud)
    np.testing.assert_array_equal(cloud.last_step.get(), cloud.twins["sh"].last_step)


def test_rows_that_are_not_listed_keep_their_values(dev, rng):
    cloud = Cloud(dev, rng, 257)
    cloud.step(*gradients(rng, 257), np.arange(257))
    before = cloud.state()
    rows = np.arange(0, 257, 2)
    cloud.step(*gradients(rng, 257), rows)
    for array, old in zip(cloud.state()["sh"], before["sh"], strict=True):
        np.testing.assert_array_equal(array[1::2], old[1::2])
        assert (array[rows] != old[rows]).any()
    cloud.step(*gradients(rng, 257), [])
    assert (cloud.last_step.get()[1::2] == 1).all() and (cloud.last_step.get()[::2] == 2).all()


def test_lazy_moments_are_dense_ones(dev, rng):
    """At every step that lists a row, its moments are those of dense Adam with gradients of 0 in
    between.
    """
    cloud, dense = Cloud(dev, rng, 33), oracle_optim.Adam(np.zeros((33, 1, 16)))
    for _ in range(40):
        grad = gradients(rng, 33)[0]
        rows = np.flatnonzero(rng.random(33) < 0.2)
        cloud.step(grad, np.zeros(33), rows)
        grad[~np.isin(np.arange(33), rows)] = 0
        dense.step(cloud.sh_gradient(grad), 0.1, SH_EPS)
        _, m, v = (array[rows] for array in cloud.state()["sh"])
        np.testing.assert_allclose(m, dense.m[rows], rtol=3e-6, atol=1e-10)
        np.testing.assert_allclose(v, dense.v[rows], rtol=3e-6, atol=1e-18)


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("block", SH_BLOCKS, ids=lambda b: b.name)
@pytest.mark.parametrize("scale", [None, moment_scale(SH_EPS)], ids=["32 bits", "16 bits"])
def test_pending_moves_are_those_that_the_next_update_catches_up_with(dev, rng, n, block, scale):
    cloud = Cloud(dev, rng, n, block, scale=scale)
    for _ in range(6):
        cloud.step(*gradients(rng, n), np.flatnonzero(rng.random(n) < 0.6))
    rows, last = np.flatnonzero(rng.random(n) < 0.7), cloud.last_step.get()
    pending = cloud.pending(rows, 10)
    np.testing.assert_array_equal(cloud.last_step.get(), last)
    assert np.isnan(np.delete(pending, rows, axis=0)).all()
    moves = cloud.twins["sh"].pending(10, 0.1, SH_EPS)
    basis = oracle_optim.block_basis(GRID.positions(cloud.ids), EYE, block)
    expected = np.einsum("nk,nkc->nc", basis, moves)
    bound = 1e-6 if scale is None else 0.01
    assert np.abs(pending[rows] - expected[rows]).max(initial=0) <= bound * np.abs(expected).max()
    if n > 1:
        assert np.abs(pending[rows]).max() > 0.01


@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_points_with_a_gradient(dev, rng, n):
    shaded = np.flatnonzero(rng.random(n) < 0.8)
    features = np.full((n, 16), np.nan, np.float32)
    features[shaded] = 0
    expected = [i for place, i in enumerate(shaded) if place % 3]
    for place, i in enumerate(shaded):
        features[i, place % 16] = (-0.0, -1e-37, np.nan)[place % 3]
    points = PointsWithGradient(dev)
    for _ in range(2):
        rows = points.rows(dev.upload(shaded, np.uint32), dev.upload(features))
        np.testing.assert_array_equal(rows.get(), np.array(expected, np.uint32))


def test_a_row_that_caught_up_is_where_dense_adam_has_moved_it(dev, rng):
    """Late in training, where the bias corrections stand still, at a constant rate and a small eps:
    nothing is lost.
    """
    cloud, dense = Cloud(dev, rng, 257), oracle_optim.Adam(np.zeros((257, 1, 16)))
    dense.t, start = 20_000, cloud.sh.get().astype(np.float64)
    cloud.last_step.set(np.full(257, 20_000, np.uint32))
    for step in range(20_001, 20_041):
        features = 100 * gradients(rng, 257)[0]
        rows = np.arange(257) if step == 20_040 else np.flatnonzero(rng.random(257) < 0.1)
        cloud.step(features, np.zeros(257), rows, step)
        features[~np.isin(np.arange(257), rows)] = 0
        dense.step(
            oracle_optim.sh_gradient(GRID.positions(cloud.ids), EYE, features, cloud.block),
            0.1,
            SH_EPS,
        )
    assert relative_error(cloud.sh.get() - start, dense.parameter) < 1e-3


@pytest.mark.parametrize("step", [100, 3000, 50_000, 10**8])
def test_many_skipped_steps(dev, rng, step):
    cloud = Cloud(dev, rng, 33)
    for at in (1, step, step + 1):
        cloud.step(*gradients(rng, 33), np.arange(33), at)
    check(cloud)


def test_opacity_stays_in_its_bounds(dev, rng):
    cloud = Cloud(dev, rng, 257)
    for step in range(40):
        cloud.step(
            np.zeros((257, 16)),
            rng.standard_normal(257) + np.linspace(-2, 2, 257),
            np.arange(step % 2, 257, 2),
        )
    opacity = cloud.opacity.get()
    assert opacity.min() == 0
    assert opacity.max() == 1
    np.testing.assert_allclose(opacity, cloud.twins["opacity"].parameter, atol=2e-6)


@pytest.mark.exact
def test_a_nan_is_not_hidden(dev, rng):
    cloud = Cloud(dev, rng, 31)
    cloud.steps = 1
    cloud.update_opacity(dev.upload(np.full(31, np.nan), np.float32))
    assert np.isnan(cloud.opacity.get()).all()


def test_sh_of_a_point_in_the_eye_stays_finite(dev):
    """No pixel sees it, so its gradient is 0; its direction is undefined."""
    grid, camera = (
        Grid((0, 0, 0), 0.5, (5, 5, 5)),
        Camera(np.column_stack([np.eye(3), [1.0, 0.5, 0]]), 9, 9, 4, 4, 8, 8),
    )
    ids = np.array([2 + 5, 3], np.uint32)
    start = np.ones((2, 3, 16), np.float32)
    adam, sh, state = PointAdam(dev), dev.upload(start), sh_moments(dev, SH_BLOCKS[2], 2)
    directions = Directions(
        dev.upload(grid.packed()), dev.upload(camera.packed((2.0, 6.0))), dev.upload(ids)
    )
    product = ShGradient(directions, dev.zeros((2, 16)))
    adam.update_sh(
        adam.all_points(1, 2), SH_BLOCKS[2], product, sh, moments=state, rate=0.5, eps=1e-15
    )
    np.testing.assert_array_equal(sh.get(), start)
    assert not state["m"].get().any()


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("block", SH_BLOCKS, ids=lambda b: b.name)
def test_half_moments_follow_the_oracle(dev, rng, n, block):
    """A half is off by up to 2^-10, and each step rounds again."""
    cloud = Cloud(dev, rng, n, block, scale=moment_scale(SH_EPS))
    for _ in range(12):
        cloud.step(*gradients(rng, n), np.flatnonzero(rng.random(n) < 0.4))
    parameter, m, v = cloud.state()["sh"]
    oracle = cloud.twins["sh"]
    moved = np.abs(oracle.parameter - cloud.start["sh"]).max()
    assert np.abs(parameter - oracle.parameter).max() < 0.01 * moved + 1e-7
    assert relative_error(m, oracle.m) < 0.005
    assert relative_error(np.sqrt(v), np.sqrt(oracle.v)) < 0.005
    np.testing.assert_array_equal(cloud.last_step.get(), oracle.last_step)


@pytest.mark.large
def test_half_moments_decay_as_they_should(dev, rng):
    """A thousand steps each take less from sqrt(v) than half a unit in its last place: rounding to
    nearest keeps all.
    """
    cloud, none = Cloud(dev, rng, 33, scale=moment_scale(SH_EPS)), np.zeros((33, 16))
    grad = np.logspace(-6, -2, 33)[:, None] * (1 + rng.random((33, 16)))
    cloud.step(grad, np.zeros(33), np.arange(33))
    for _ in range(1000):
        cloud.step(none, np.zeros(33), np.arange(33))
    _, m, v = cloud.state()["sh"]
    ratio = np.sqrt(v) / np.sqrt(cloud.twins["sh"].v)
    assert abs(ratio.mean() - 1) < 0.005
    assert ratio.std() < 0.05
    assert not m.any()


@pytest.mark.parametrize("eps", [1e-12, 4e-7, 1.0])
def test_moment_scale_puts_eps_into_the_range_of_a_half(eps):
    assert 2**-6.5 <= eps * moment_scale(eps) <= 2**-5.5
    assert np.log2(moment_scale(eps)) % 1 == 0


def test_rounding_to_half(dev):
    """Each value becomes one of its two neighbours, and on the average itself; the largest half
    bounds, NaN stays.
    """
    values = np.float32(
        [
            0,
            1,
            -1.0003,
            0.1,
            6e-5,
            -3e-8,
            1e-8,
            6.1035e-5,
            65519,
            7e4,
            -1e30,
            np.inf,
            np.nan,
            9,
            -7e-6,
            2,
        ]
    )
    source = """#include "training/half16.h"
        kernel void to_half(global const float16 *value, global half *rounded) {
            const uint i = get_global_id(0);
            store_half_part(value[0], random_part(77 + i) >> 19, rounded, i);
        }"""
    kernel = cl.Program(dev.context, source).build(["-I", str(kernel_folder())]).to_half
    rounded = dev.empty((20_000, 16), np.float16)
    kernel(dev.queue, (20_000,), None, dev.upload(values).data, rounded.data)
    rounded = rounded.get().astype(np.float64)
    exact = np.clip(values, -65504, 65504).astype(np.float64)
    assert np.isnan(rounded[:, 12]).all()
    rounded, exact = np.delete(rounded, 12, 1), np.delete(exact, 12)
    step = np.maximum(2.0 ** np.floor(np.log2(np.maximum(np.abs(exact), 1e-30)) - 10), 2.0**-24)
    assert (np.abs(rounded - exact) < step).all()
    assert (np.abs(rounded.mean(axis=0) - exact) < 0.02 * step).all()


def test_every_half_is_read_and_written_exactly(dev):
    """A half is a value of its own: no dither moves it. Infinities become the largest half."""
    source = """#include "training/half16.h"
        kernel void copy(global const half *from, global float16 *value, global half *to) {
            const uint i = get_global_id(0);
            value[i] = vload_half16(i, from);
            store_half_part(value[i], random_part(i) >> 19, to, i);
        }"""
    kernel = cl.Program(dev.context, source).build(["-I", str(kernel_folder())]).copy
    halves = np.arange(2**16, dtype=np.uint16)
    value, to = dev.empty((2**16,)), dev.empty((2**16,), np.uint16)
    kernel(dev.queue, (2**12,), None, dev.upload(halves).data, value.data, to.data)
    exact = halves.view(np.float16)
    np.testing.assert_array_equal(value.get(), exact.astype(np.float32))
    np.testing.assert_array_equal(to.get().view(np.float16), np.clip(exact, -65504, 65504))


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
