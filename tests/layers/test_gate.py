"""cl/layers/gate.cl against float64."""

import numpy as np
import pytest
from oracle import layers as oracle
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.layers.gate import gate_backward, gate_forward
from pp_cl.layers.tiles import some_tiles
from pp_cl.reference.differences import numeric_gradient

SHAPES = [(1, 1, 16), (1, 5, 3), (31, 33, 17), (3, 257, 32), (12, 1, 48), (4, 8, 1)]
SHAPES += [(2, 3, channels) for channels in AWKWARD_SIZES]


def run(dev, x, grad_out):
    """(output, gradient of x) from the device, as float32."""
    out, grad_x = dev.empty(grad_out.shape), dev.empty(x.shape)
    device_x = dev.upload(x, np.float32)
    gate_forward(dev, device_x, out)
    gate_backward(dev, device_x, dev.upload(grad_out, np.float32), grad_x)
    return out.get(), grad_x.get()


@pytest.mark.parametrize("shape", SHAPES)
def test_forward_and_backward(dev, rng, shape):
    h, w, c = shape
    x = rng.normal(0, 3, (h, w, 2 * c)).astype(np.float32)
    grad_out = rng.normal(size=shape).astype(np.float32)
    out, grad_x = run(dev, x, grad_out)
    assert relative_error(out, oracle.gate(x)) < 5e-7
    assert relative_error(grad_x, oracle.gate_gradient(x, grad_out)) < 5e-7


def test_gradient_by_finite_differences(dev, rng):
    x, grad_out = rng.normal(0, 2, (3, 4, 10)), rng.normal(size=(3, 4, 5))
    x, grad_out = x.astype(np.float32), grad_out.astype(np.float32)
    numeric = numeric_gradient(lambda v: (oracle.gate(v) * grad_out).sum(), x, 1e-5)
    assert relative_error(run(dev, x, grad_out)[1].ravel(), numeric) < 1e-6


def pairs_of(values):
    """(1, N, 2) of all pairs (feature, gate) of some values, as one channel each."""
    return np.stack(np.meshgrid(values, values), -1).reshape(1, -1, 2).astype(np.float32)


def test_every_element_is_exact_wherever_the_formula_would_cancel_or_overflow(dev):
    """Against its own value, not against the largest: expm1 near 0, sigmoid and its derivative in
    both tails. What float32 stores as a subnormal number or not at all may become 0.
    """
    powers = 10.0 ** np.arange(-12, 2)
    x = pairs_of([*-powers, 0, *powers, -40, 40, -60, 60])
    out, grad_x = run(dev, x, np.ones((1, x.shape[1], 1)))
    for actual, expected in (
        (out, oracle.gate(x)),
        (grad_x, oracle.gate_gradient(x, np.ones_like(out))),
    ):
        np.testing.assert_allclose(actual, expected, rtol=3e-6, atol=2e-38)


@pytest.mark.exact
def test_huge_values_saturate(dev):
    x = pairs_of([-3e38, -1e4, -80, 0, 80, 1e4, 3e38])
    out, grad_x = run(dev, x, np.ones((1, x.shape[1], 1)))
    assert np.isfinite(out).all() and np.isfinite(grad_x).all()
    np.testing.assert_allclose(out, oracle.gate(x), rtol=1e-6, atol=1e-30)
    expected = oracle.gate_gradient(x, np.ones_like(out))
    np.testing.assert_allclose(grad_x, expected, rtol=1e-6, atol=1e-5)
    closed, opened = x[..., 1] <= -1e4, x[..., 1] >= 1e4
    assert not out[closed].any() and not grad_x[closed].any()
    positive = opened & (x[..., 0] > 0)
    np.testing.assert_array_equal(out[positive][:, 0], x[positive][:, 0])


@pytest.mark.parametrize("place", [0, 1])
def test_nan_comes_through(dev, place):
    x = np.ones((1, 3, 2), np.float32)
    x[0, 1, place] = np.nan
    out, grad_x = run(dev, x, np.ones((1, 3, 1)))
    np.testing.assert_array_equal(np.isnan(out[0, :, 0]), [False, True, False])
    assert np.isnan(grad_x[0, 1]).any() and np.isfinite(grad_x[0, ::2]).all()


def test_only_the_tiles_that_are_counted(dev, rng):
    count = np.array([[1, 0, 2], [0, 3, 0]])
    x = rng.normal(size=(7, 10, 34)).astype(np.float32)
    grad_out = rng.normal(size=(7, 10, 17)).astype(np.float32)
    tiles = some_tiles(dev, (7, 10), count)
    out, grad_x = dev.empty(grad_out.shape), dev.empty(x.shape)  # of NaN
    gate_forward(dev, dev.upload(x), out, tiles=tiles)
    gate_backward(dev, dev.upload(x), dev.upload(grad_out), grad_x, tiles=tiles)
    chosen = count.repeat(4, 0).repeat(4, 1)[:7, :10] > 0
    for actual, expected in (
        (out.get(), oracle.gate(x)),
        (grad_x.get(), oracle.gate_gradient(x, grad_out)),
    ):
        assert np.isnan(actual[~chosen]).all()
        assert relative_error(actual[chosen], expected[chosen]) < 5e-7


def test_wrong_shapes_are_refused(dev):
    x, out = dev.zeros((2, 3, 32)), dev.zeros((2, 3, 16))
    with pytest.raises(ValueError, match="expected \\(2, 3, 64\\)"):
        gate_forward(dev, x, x)
    with pytest.raises(ValueError, match="expected \\(2, 4, 32\\)"):
        gate_backward(dev, x, dev.zeros((2, 4, 16)), x)
    with pytest.raises(ValueError, match="tiles of \\(4, 4\\)"):
        gate_forward(dev, x, out, tiles=some_tiles(dev, (4, 4), np.ones((1, 1))))
