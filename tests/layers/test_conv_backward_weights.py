"""cl/layers/conv_backward_weights.cl against float64."""

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from pp_cl.layers.conv_backward_weights import (
    conv_backward_weights,
    flip_weights,
    partial_floats,
)
from support.comparisons import relative_error
from support.conv_layers import SHAPES, layer
from support.launches import check_parts

from pp_cl.layers import conv_backward_weights as module
from pp_cl.layers.choice import SHIPPED
from pp_cl.layers.conv import pack_bias, pack_weights, unpack_weights
from pp_cl.reference.differences import numeric_gradient


def run_backward_weights(dev, grad_out, k, *sources, blocking=SHIPPED["CPU"]):
    """((CO, CI, K, K), (CO,)) gradients from the device; asserts that the padding of both is
    zero.
    """
    co, ci = grad_out.shape[2], sum(s.shape[2] for s in sources)
    grad_weight, grad_bias = dev.empty((-(-co // 16), k, k, ci, 16)), dev.empty(-(-co // 16) * 16)
    partial = dev.empty(partial_floats(len(grad_out), grad_weight.shape))
    conv_backward_weights(
        dev,
        tuple(dev.upload(s) for s in sources),
        dev.upload(grad_out),
        grad_weight,
        grad_bias=grad_bias,
        partial=partial,
        blocking=blocking,
    )
    weight, bias = unpack_weights(grad_weight.get(), co), grad_bias.get()[:co]
    np.testing.assert_array_equal(pack_weights(weight), grad_weight.get())
    np.testing.assert_array_equal(pack_bias(bias), grad_bias.get())
    return weight, bias


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_backward_weights(dev, rng, shape, k):
    height, width, ci, co = shape
    x = rng.normal(size=(height, width, ci)).astype(np.float32)
    grad_out = rng.normal(size=(height, width, co)).astype(np.float32)
    _, expected_weight, expected_bias = conv_gradients(x, np.zeros((co, ci, k, k)), grad_out)
    weight, bias = run_backward_weights(dev, grad_out, k, x)
    assert relative_error(weight, expected_weight) < 5e-6
    assert relative_error(bias, expected_bias) < 5e-6


@pytest.mark.parametrize("limit", [1 << 24, 20000, 1])
def test_two_sources_and_few_parts(dev, rng, monkeypatch, limit):
    """Parts grow when scratch is short, up to a single one."""
    monkeypatch.setattr(module, "PARTIAL_FLOATS", limit)
    x, x2 = (rng.normal(size=(33, 10, c)).astype(np.float32) for c in (16, 20))
    grad_out = rng.normal(size=(33, 10, 32)).astype(np.float32)
    _, expected_weight, expected_bias = conv_gradients(
        np.concatenate([x, x2], 2), np.zeros((32, 36, 3, 3)), grad_out
    )
    weight, bias = run_backward_weights(dev, grad_out, 3, x, x2)
    assert relative_error(weight, expected_weight) < 5e-6
    assert relative_error(bias, expected_bias) < 5e-6


def test_launches_in_parts_compute_the_same_bits(dev, rng, monkeypatch):
    x, grad_out = (rng.normal(size=(33, 10, c)).astype(np.float32) for c in (16, 20))
    parts = -(-33 // module.ROWS_PER_PART)

    def run():
        return run_backward_weights(dev, grad_out, 3, x)

    assert check_parts(dev, monkeypatch, "conv_backward_weights", run) == parts


def test_backward_weights_by_finite_differences(dev, rng):
    x = rng.normal(size=(3, 4, 3))
    weight, bias = layer(rng, 3, 5, 3)
    grad_out = rng.normal(size=(3, 4, 5)).astype(np.float32)
    grad_weight, grad_bias = run_backward_weights(dev, grad_out, 3, x.astype(np.float32))
    numeric = numeric_gradient(lambda v: (conv(x, v, bias) * grad_out).sum(), weight, 1e-4)
    assert relative_error(grad_weight.ravel(), numeric) < 3e-6
    numeric = numeric_gradient(lambda v: (conv(x, weight, v) * grad_out).sum(), bias, 1e-4)
    assert relative_error(grad_bias, numeric) < 3e-6


@pytest.mark.parametrize(
    "k, ci, co, first, c", [(3, 16, 16, 0, 16), (3, 48, 3, 16, 32), (1, 20, 32, 16, 4)]
)
def test_flip(dev, rng, k, ci, co, first, c):
    weight = rng.normal(size=(co, ci, k, k)).astype(np.float32)
    flipped = dev.empty((-(-c // 16), k, k, co, 16))
    flip_weights(dev, dev.upload(pack_weights(weight)), first, flipped, blocking=SHIPPED["CPU"])
    expected = weight[:, first : first + c, ::-1, ::-1].transpose(1, 0, 2, 3)
    np.testing.assert_array_equal(flipped.get(), pack_weights(expected))


def test_hard_inputs(dev, rng):
    x = (1e3 + rng.normal(size=(64, 33, 16))).astype(np.float32)
    grad_out = rng.normal(size=(64, 33, 16)).astype(np.float32)
    _, expected, _ = conv_gradients(x, np.zeros((16, 16, 3, 3)), grad_out)
    # the sums cancel: the error is small against the terms, not against the result
    scale = np.abs(grad_out).sum((0, 1)).max() * 1e3
    assert np.abs(run_backward_weights(dev, grad_out, 3, x)[0] - expected).max() < 1e-6 * scale
    weight, bias = run_backward_weights(dev, np.zeros_like(grad_out), 3, x)
    assert not weight.any() and not bias.any()


def test_work_groups_of_a_gpu(dev, rng):
    x, grad_out = (rng.normal(size=(19, 10, c)).astype(np.float32) for c in (20, 48))
    weight, bias = run_backward_weights(dev, grad_out, 3, x, blocking=SHIPPED["GPU"])
    _, expected_weight, expected_bias = conv_gradients(x, np.zeros((48, 20, 3, 3)), grad_out)
    assert relative_error(weight, expected_weight) < 5e-6
    assert relative_error(bias, expected_bias) < 5e-6


def test_same_bits_twice(dev, rng):
    x = rng.normal(size=(57, 40, 32)).astype(np.float32)
    grad_out = rng.normal(size=(57, 40, 16)).astype(np.float32)
    first, second = (
        run_backward_weights(dev, grad_out, 3, x),
        run_backward_weights(dev, grad_out, 3, x),
    )
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_wrong_shapes_are_refused(dev):
    x, grad_out, scratch = dev.zeros((4, 4, 16)), dev.zeros((4, 4, 32)), dev.zeros(1 << 16)
    grad_weight, grad_bias = dev.zeros((2, 3, 3, 16, 16)), dev.zeros(32)
    given = {"grad_bias": grad_bias, "partial": scratch, "blocking": SHIPPED["CPU"]}
    for sources, change, match in (
        ((x, x), {}, "weight gradient"),
        ((x,), {"grad_bias": dev.zeros(16)}, "weight gradient"),
        ((x,), {"partial": dev.zeros(10)}, "scratch has 10 floats"),
    ):
        with pytest.raises(ValueError, match=match):
            conv_backward_weights(dev, sources, grad_out, grad_weight, **given | change)
