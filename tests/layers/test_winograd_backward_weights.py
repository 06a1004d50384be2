"""cl/layers/winograd_backward_weights.cl against float64."""

import numpy as np
import pytest
from oracle.conv import conv_gradients
from pp_cl.layers.winograd_backward_weights import (
    backward_weights_floats,
    winograd_backward_weights,
)
from support.comparisons import relative_error
from support.guarded import large
from support.winograd_layers import BOUNDS, SHAPES, form, run_backward_weights

from pp_cl.layers.conv import Work

# With parts of 128 x 128 channels: several, and tails of both kinds
PARTS = [*map(large, [(5, 6, 80, 144), (9, 7, 144, 48), (12, 20, 272, 256)])]
# Narrow weights: 2 and 8 parts of the tiles of F(4x4), 8 and 16 of F(2x2)
TILE_PARTS = [*map(large, [(33, 97, 16, 32), (130, 81, 32, 16)])]


@pytest.mark.parametrize("m", BOUNDS)
@pytest.mark.parametrize("shape", SHAPES + PARTS + TILE_PARTS)
def test_backward_weights(dev, rng, shape, m):
    height, width, ci, co = shape
    x = rng.normal(size=(height, width, ci)).astype(np.float32)
    grad_out = rng.normal(size=(height, width, co)).astype(np.float32)
    _, expected_weight, expected_bias = conv_gradients(x, np.zeros((co, ci, 3, 3)), grad_out)
    weight, bias = run_backward_weights(dev, form(m), grad_out, x)
    assert relative_error(weight, expected_weight) < BOUNDS[m]
    assert relative_error(bias, expected_bias) < BOUNDS[m]


@pytest.mark.parametrize("m", BOUNDS)
@pytest.mark.parametrize("c1, c2", [(16, 48), large(80, 16)])
def test_two_sources(dev, rng, c1, c2, m):
    x, x2 = (rng.normal(size=(33, 10, c)).astype(np.float32) for c in (c1, c2))
    grad_out = rng.normal(size=(33, 10, 32)).astype(np.float32)
    joined = np.concatenate([x, x2], 2)
    _, expected_weight, expected_bias = conv_gradients(
        joined, np.zeros((32, c1 + c2, 3, 3)), grad_out
    )
    weight, bias = run_backward_weights(dev, form(m), grad_out, x, x2)
    assert relative_error(weight, expected_weight) < BOUNDS[m]
    assert relative_error(bias, expected_bias) < BOUNDS[m]


@pytest.mark.parametrize("m", BOUNDS)
def test_hard_inputs(dev, rng, m):
    x = (1e3 + rng.normal(size=(64, 33, 16))).astype(np.float32)
    grad_out = rng.normal(size=(64, 33, 16)).astype(np.float32)
    _, expected, _ = conv_gradients(x, np.zeros((16, 16, 3, 3)), grad_out)
    # the sums cancel: the error is small against the terms, not against the result
    scale = np.abs(grad_out).sum((0, 1)).max() * 1e3
    assert (
        np.abs(run_backward_weights(dev, form(m), grad_out, x)[0] - expected).max() < 1e-6 * scale
    )
    weight, bias = run_backward_weights(dev, form(m), np.zeros_like(grad_out), x)
    assert not weight.any() and not bias.any()


@pytest.mark.large
@pytest.mark.parametrize("units", [1, 3, 100])
@pytest.mark.parametrize("height, channels", [(37, 144), (131, 48)])
def test_same_bits_for_any_number_of_compute_units(dev, rng, monkeypatch, height, channels, units):
    x = rng.normal(size=(height, 40, channels)).astype(np.float32)
    grad_out = rng.normal(size=(height, 40, channels)).astype(np.float32)
    expected = run_backward_weights(dev, form(4), grad_out, x)
    monkeypatch.setitem(dev.info, "compute_units", units)
    for actual, value in zip(
        run_backward_weights(dev, form(4), grad_out, x), expected, strict=True
    ):
        np.testing.assert_array_equal(actual, value)


@pytest.mark.large
def test_wrong_shapes_are_refused(dev):
    x, grad_out = dev.zeros((4, 4, 16)), dev.zeros((4, 4, 32))
    grad_weight, grad_bias = dev.zeros((2, 3, 3, 16, 16)), dev.zeros(32)
    scratch, parts = backward_weights_floats(dev, form(4), grad_weight.shape)
    work = Work.empty(dev, scratch, parts)
    given = {"grad_weight": grad_weight, "grad_bias": grad_bias, "work": work}
    for sources, change, match in (
        ((x, x), {}, "\\[16, 16\\] to 32 channels"),
        ((x,), {"grad_bias": dev.zeros(16)}, "bias \\(16,\\)"),
        ((dev.zeros((4, 4, 3)),), {"grad_weight": dev.zeros((2, 3, 3, 3, 16))}, "\\[3\\] to 32"),
        ((x,), {"work": Work.empty(dev, 0, parts)}, "scratch of 16 floats"),
        ((x,), {"work": Work.empty(dev, scratch, 10)}, "parts of the gradient of 10 floats"),
    ):
        with pytest.raises(ValueError, match=match):
            winograd_backward_weights(dev, form(4), sources, grad_out, **given | change)
