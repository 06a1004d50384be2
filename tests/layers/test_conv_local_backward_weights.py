"""cl/layers/conv_local_backward_weights.cl against float64; errors against the direct kernel's."""

import numpy as np
import pytest
from oracle.conv import conv_gradients
from pp_cl.layers.conv_local_backward_weights import conv_local_backward_weights
from support.comparisons import relative_error
from support.conv_layers import LOCAL_SHAPES
from support.guarded import large
from support.launches import check_parts

from pp_cl.layers import conv_backward_weights as direct
from pp_cl.layers import conv_local_backward_weights as module
from pp_cl.layers.choice import SHIPPED
from pp_cl.layers.conv import pack_bias, pack_weights, unpack_weights


def run_backward_weights(dev, grad_out, k, *sources, run=conv_local_backward_weights, **given):
    """((CO, CI, K, K), (CO,)) gradients from the device; asserts that the padding of both is
    zero.
    """
    co, ci = grad_out.shape[2], sum(s.shape[2] for s in sources)
    grad_weight, grad_bias = dev.empty((-(-co // 16), k, k, ci, 16)), dev.empty(-(-co // 16) * 16)
    run(
        dev,
        tuple(dev.upload(s) for s in sources),
        dev.upload(grad_out),
        grad_weight,
        grad_bias=grad_bias,
        partial=dev.empty(direct.partial_floats(len(grad_out), grad_weight.shape)),
        **given,
    )
    weight, bias = unpack_weights(grad_weight.get(), co), grad_bias.get()[:co]
    np.testing.assert_array_equal(pack_weights(weight), grad_weight.get())
    np.testing.assert_array_equal(pack_bias(bias), grad_bias.get())
    return weight, bias


def norm_error(actual, expected):
    """The relative L2 error, which is steadier than the largest."""
    return np.linalg.norm(actual - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("shape", LOCAL_SHAPES)
def test_backward_weights(dev, rng, shape, k):
    height, width, ci, co = shape
    x = rng.normal(size=(height, width, ci)).astype(np.float32)
    grad_out = rng.normal(size=(height, width, co)).astype(np.float32)
    _, expected_weight, expected_bias = conv_gradients(x, np.zeros((co, ci, k, k)), grad_out)
    weight, bias = run_backward_weights(dev, grad_out, k, x)
    assert relative_error(weight, expected_weight) < 5e-6
    assert relative_error(bias, expected_bias) < 5e-6
    if weight.size > 100:  # the error of few numbers is luck
        given = {"run": direct.conv_backward_weights, "blocking": SHIPPED["CPU"]}
        by_direct = run_backward_weights(dev, grad_out, k, x, **given)[0]
        # a tile is longer than the rows of few pixels, which the direct kernel sums
        most = norm_error(by_direct, expected_weight) + (2**-25 if height * width < 200 else 0)
        assert norm_error(weight, expected_weight) < most


@pytest.mark.parametrize("limit", [1 << 24, *map(large, [20000, 1])])
def test_two_sources_and_few_parts(dev, rng, monkeypatch, limit):
    """Parts grow when scratch is short, up to a single one."""
    monkeypatch.setattr(direct, "PARTIAL_FLOATS", limit)
    x, x2 = (rng.normal(size=(33, 10, c)).astype(np.float32) for c in (16, 20))
    grad_out = rng.normal(size=(33, 10, 48)).astype(np.float32)
    joined = np.concatenate([x, x2], 2)
    _, expected_weight, expected_bias = conv_gradients(joined, np.zeros((48, 36, 3, 3)), grad_out)
    weight, bias = run_backward_weights(dev, grad_out, 3, x, x2)
    assert relative_error(weight, expected_weight) < 5e-6
    assert relative_error(bias, expected_bias) < 5e-6


@pytest.mark.large
def test_a_background_keeps_its_digits(dev):
    """A sum of equal numbers over an image, one by one, would lose three of them."""
    x, grad_out = np.full((64, 257, 16), 1.1, np.float32), np.full((64, 257, 3), 0.7, np.float32)
    _, expected_weight, expected_bias = conv_gradients(x, np.zeros((3, 16, 3, 3)), grad_out)
    weight, bias = run_backward_weights(dev, grad_out, 3, x)
    assert relative_error(weight, expected_weight) < 2e-6
    assert relative_error(bias, expected_bias) < 2e-6


def test_smaller_work_groups_compute_the_same_bits(dev, rng, monkeypatch):
    x, grad_out = (rng.normal(size=(9, 21, c)).astype(np.float32) for c in (16, 32))
    expected = run_backward_weights(dev, grad_out, 3, x)
    asked = []

    def runs(program, kernel, items):
        asked.append(items)
        return items <= 48

    monkeypatch.setattr(module, "runs", runs)
    for actual, same in zip(run_backward_weights(dev, grad_out, 3, x), expected, strict=True):
        np.testing.assert_array_equal(actual, same)
    assert asked == [96, 48]


@pytest.mark.parametrize("k, launched", [(1, 2), large(3, 3)])
def test_launches_in_parts_compute_the_same_bits(dev, rng, monkeypatch, k, launched):
    x, grad_out = (rng.normal(size=(9, 21, c)).astype(np.float32) for c in (36, 20))
    count = check_parts(
        dev,
        monkeypatch,
        "conv_local_backward_weights",
        lambda: run_backward_weights(dev, grad_out, k, x),
    )
    assert count == launched  # groups of 16 input channels, of 1x1 kernels 32


@pytest.mark.large
def test_same_bits_twice(dev, rng):
    x, grad_out = (rng.normal(size=(57, 40, c)).astype(np.float32) for c in (32, 16))
    runs = [run_backward_weights(dev, grad_out, 3, x) for _ in range(2)]
    for first, second in zip(*runs, strict=True):
        np.testing.assert_array_equal(first, second)


def test_wrong_shapes_are_refused(dev):
    x, grad_out, scratch = dev.zeros((4, 4, 16)), dev.zeros((4, 4, 32)), dev.zeros(1 << 16)
    grad_weight, grad_bias = dev.zeros((2, 3, 3, 16, 16)), dev.zeros(32)
    given = {"grad_bias": grad_bias, "partial": scratch}
    for sources, change, match in (
        ((x, x), {}, "weight gradient"),
        ((x,), {"grad_bias": dev.zeros(16)}, "weight gradient"),
        ((x,), {"partial": dev.zeros(10)}, "scratch has 10 floats"),
    ):
        with pytest.raises(ValueError, match=match):
            conv_local_backward_weights(dev, sources, grad_out, grad_weight, **given | change)
