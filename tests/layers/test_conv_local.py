"""cl/layers/conv_local.cl against float64, and against the direct kernel."""

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from pp_cl.layers.conv_backward_weights import flip_weights
from support.comparisons import relative_error
from support.conv_layers import (
    LOCAL_SHAPES,
    check_backward_input,
    check_hard_inputs,
    check_same_bits,
    layer,
)
from support.guarded import large
from support.launches import check_parts

from pp_cl.layers import conv_local as module
from pp_cl.layers.choice import SHIPPED
from pp_cl.layers.conv import conv_forward, pack_bias, pack_weights
from pp_cl.layers.conv_local import conv_local_backward_input, conv_local_forward, quads


def run_forward(dev, x, weight, bias, relu, x2=None, forward=conv_local_forward, **given):
    out = dev.empty((*x.shape[:2], len(bias)))
    forward(
        dev,
        tuple(dev.upload(source) for source in (x, x2) if source is not None),
        dev.upload(pack_weights(weight)),
        dev.upload(pack_bias(bias)),
        out=out,
        relu=relu,
        **given,
    )
    return out.get()


def run_backward_input(dev, x, weight, grad_out, masked, first=0):
    co, _, k, _ = weight.shape
    flipped = dev.empty((-(-x.shape[2] // 16), k, k, co, 16))
    packed = dev.upload(pack_weights(weight))
    flip_weights(dev, packed, first, flipped, blocking=SHIPPED["CPU"])
    grad_x, mask = dev.empty(x.shape), dev.upload(x) if masked else None
    conv_local_backward_input(dev, flipped, dev.upload(grad_out), grad_x, mask=mask)
    return grad_x.get()


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("shape", LOCAL_SHAPES)
def test_forward(dev, rng, shape, k):
    height, width, ci, co = shape
    x = rng.normal(size=(height, width, ci)).astype(np.float32)
    weight, bias = layer(rng, ci, co, k)
    given = dev, x, weight, bias
    assert relative_error(run_forward(*given, True), conv(x, weight, bias, True)) < 3e-6
    expected = conv(x, weight, bias)
    error = relative_error(run_forward(*given, False), expected)
    direct = run_forward(*given, False, forward=conv_forward, blocking=SHIPPED["CPU"])
    # at most the direct kernel's, but for the last bit of a few roundings in another order
    assert error < min(3e-6, 1.2 * relative_error(direct, expected) + 2**-24)


@pytest.mark.parametrize("c1, c2", [(3, 20), large(16, 16), large(16, 48)])
def test_two_sources_are_a_concatenation(dev, rng, c1, c2):
    x = rng.normal(size=(7, 29, c1 + c2)).astype(np.float32)
    weight, bias = layer(rng, c1 + c2, 16, 3)
    first, second = (np.ascontiguousarray(s) for s in np.split(x, [c1], 2))
    actual = run_forward(dev, first, weight, bias, True, second)
    assert relative_error(actual, conv(x, weight, bias, True)) < 3e-6
    np.testing.assert_array_equal(actual, run_forward(dev, x, weight, bias, True))


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("shape", LOCAL_SHAPES)
def test_backward_input(dev, rng, shape, k):
    check_backward_input(dev, rng, shape, k, run_backward_input)


@pytest.mark.large
def test_backward_input_of_the_second_source(dev, rng):
    x2 = rng.normal(size=(9, 14, 20)).astype(np.float32)
    weight, _ = layer(rng, 16 + 20, 48, 3)
    grad_out = rng.normal(size=(9, 14, 48)).astype(np.float32)
    both = np.concatenate([np.zeros((9, 14, 16)), x2], 2)
    expected = conv_gradients(both, weight, grad_out)[0][..., 16:]
    actual = run_backward_input(dev, x2, weight, grad_out, False, first=16)
    assert relative_error(actual, expected) < 3e-6


@pytest.mark.large
def test_hard_inputs(dev, rng):
    check_hard_inputs(dev, rng, run_forward, run_backward_input)


@pytest.mark.large
def test_same_bits_twice(dev, rng):
    check_same_bits(dev, rng, run_forward)


@pytest.mark.parametrize("most", [32, large(128)])
def test_smaller_work_groups_compute_the_same_bits(dev, rng, monkeypatch, most):
    x = rng.normal(size=(9, 30, 16)).astype(np.float32)
    weight, bias = layer(rng, 16, 16, 3)
    expected = run_forward(dev, x, weight, bias, True)
    tried = []

    def runs(program, kernel, items):
        tried.append(items)
        return items <= most

    monkeypatch.setattr(module, "runs", runs)
    np.testing.assert_array_equal(run_forward(dev, x, weight, bias, True), expected)
    assert tried == [n for n in module.GROUPS if n >= most]


@pytest.mark.parametrize("k", [1, large(3)])
def test_launches_in_parts_compute_the_same_bits(dev, rng, monkeypatch, k):
    x = rng.normal(size=(9, 30, 16)).astype(np.float32)
    weight, bias = layer(rng, 16, 64, k)
    given = dev, monkeypatch, "conv_local_forward"
    # 3 x 8 tiles, 8 of 64 channels in a group of 256 work-items
    assert check_parts(*given, lambda: run_forward(dev, x, weight, bias, True)) == 3
    x, grad_out = (rng.normal(size=(9, 30, c)).astype(np.float32) for c in (64, 16))
    weight, _ = layer(rng, 64, 16, k)
    given = dev, monkeypatch, "conv_local_backward_input"
    assert check_parts(*given, lambda: run_backward_input(dev, x, weight, grad_out, True)) == 3


def test_what_a_work_group_computes():
    """All of the blocks of 16 channels, and no other."""
    expected = {3: 4, 16: 4, 20: 8, 32: 8, 48: 4, 64: 16, 80: 4, 96: 8, 128: 16, 512: 16}
    assert {channels: quads(channels, True) for channels in expected} == expected
    assert quads(64, False) == 4


def test_relu_hides_no_nan(dev, rng):
    x = rng.normal(size=(5, 7, 16)).astype(np.float32)
    x[2, 3, 4] = np.nan
    weight = rng.normal(size=(16, 16, 3, 3))
    bad = np.isnan(run_forward(dev, x, weight, np.zeros(16), True)).all(axis=2)
    assert bad[1:4, 2:5].all() and bad.sum() == 9


def test_wrong_shapes_are_refused(dev):
    x, out = dev.zeros((4, 4, 16)), dev.zeros((4, 4, 32))
    weight, bias = dev.zeros((2, 3, 3, 16, 16)), dev.zeros(32)
    for sources, bias_, out_, match in (
        ((x, x), bias, out, "16 \\+ 16 to 32 channels"),
        ((x,), dev.zeros(16), out, "bias"),
        ((x,), bias, dev.zeros((4, 5, 32)), "width"),
    ):
        with pytest.raises(ValueError, match=match):
            conv_local_forward(dev, sources, weight, bias_, out=out_, relu=False)
    with pytest.raises(ValueError, match="flipped"):
        conv_local_backward_input(dev, weight, out, x, mask=None)
