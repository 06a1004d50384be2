"""cl/layers/conv.cl against float64."""

from dataclasses import replace

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from pp_cl.layers.conv_backward_weights import flip_weights
from support.comparisons import relative_error
from support.conv_layers import (
    SHAPES,
    check_backward_input,
    check_hard_inputs,
    check_same_bits,
    layer,
)
from support.launches import check_parts

from pp_cl.layers.choice import SHIPPED
from pp_cl.layers.conv import (
    conv_backward_input,
    conv_forward,
    pack_bias,
    pack_weights,
    unpack_weights,
)
from pp_cl.reference.differences import numeric_gradient


def run_forward(dev, x, weight, bias, relu, x2=None, blocking=SHIPPED["CPU"]):
    out = dev.empty((*x.shape[:2], len(bias)))
    conv_forward(
        dev,
        tuple(dev.upload(source) for source in (x, x2) if source is not None),
        dev.upload(pack_weights(weight)),
        dev.upload(pack_bias(bias)),
        out=out,
        relu=relu,
        blocking=blocking,
    )
    return out.get()


def run_backward_input(dev, x, weight, grad_out, masked, first=0, blocking=SHIPPED["CPU"]):
    co, _, k, _ = weight.shape
    flipped = dev.empty((-(-x.shape[2] // 16), k, k, co, 16))
    flip_weights(dev, dev.upload(pack_weights(weight)), first, flipped, blocking=blocking)
    grad_x = dev.empty(x.shape)
    mask = dev.upload(x) if masked else None
    conv_backward_input(dev, flipped, dev.upload(grad_out), grad_x, mask=mask, blocking=blocking)
    return grad_x.get()


def test_packing_is_exact(rng):
    weight = rng.normal(size=(20, 5, 3, 3)).astype(np.float32)
    packed = pack_weights(weight)
    assert packed.shape == (2, 3, 3, 5, 16)
    assert packed[1, 2, 0, 4, 3] == weight[19, 4, 2, 0]
    assert not packed[1, ..., 4:].any()
    np.testing.assert_array_equal(unpack_weights(packed, 20), weight)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_forward(dev, rng, shape, k):
    height, width, ci, co = shape
    x = rng.normal(size=(height, width, ci)).astype(np.float32)
    weight, bias = layer(rng, ci, co, k)
    assert relative_error(run_forward(dev, x, weight, bias, False), conv(x, weight, bias)) < 3e-6
    assert (
        relative_error(run_forward(dev, x, weight, bias, True), conv(x, weight, bias, True)) < 3e-6
    )


@pytest.mark.parametrize("c1, c2", [(16, 16), (16, 48), (3, 20)])
def test_two_sources_are_a_concatenation(dev, rng, c1, c2):
    x = rng.normal(size=(7, 29, c1 + c2)).astype(np.float32)
    weight, bias = layer(rng, c1 + c2, 32, 3)
    actual = run_forward(
        dev,
        np.ascontiguousarray(x[..., :c1]),
        weight,
        bias,
        True,
        np.ascontiguousarray(x[..., c1:]),
    )
    assert relative_error(actual, conv(x, weight, bias, True)) < 3e-6


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_backward_input(dev, rng, shape, k):
    check_backward_input(dev, rng, shape, k, run_backward_input)


def test_backward_input_of_the_second_source(dev, rng):
    x2 = rng.normal(size=(9, 14, 20)).astype(np.float32)
    weight, _ = layer(rng, 16 + 20, 48, 3)
    grad_out = rng.normal(size=(9, 14, 48)).astype(np.float32)
    expected = conv_gradients(np.concatenate([np.zeros((9, 14, 16)), x2], 2), weight, grad_out)[0][
        ..., 16:
    ]
    assert (
        relative_error(run_backward_input(dev, x2, weight, grad_out, False, first=16), expected)
        < 3e-6
    )


def test_backward_input_by_finite_differences(dev, rng):
    x = rng.normal(size=(3, 4, 3))
    weight, bias = layer(rng, 3, 5, 3)
    grad_out = rng.normal(size=(3, 4, 5)).astype(np.float32)
    numeric = numeric_gradient(lambda v: (conv(v, weight, bias) * grad_out).sum(), x, 1e-4)
    actual = run_backward_input(dev, x.astype(np.float32), weight, grad_out, False)
    assert relative_error(actual.ravel(), numeric) < 3e-6


def test_hard_inputs(dev, rng):
    check_hard_inputs(dev, rng, run_forward, run_backward_input)


def test_work_groups_of_a_gpu(dev, rng):
    """The pixels and work-groups that other devices get: their tails reach beyond the image and the
    channels.
    """
    gpu = SHIPPED["GPU"]
    for height, width, ci, co in ((5, 37, 16, 48), (3, 2, 3, 20)):
        x, grad_out = (rng.normal(size=(height, width, c)).astype(np.float32) for c in (ci, co))
        weight, bias = layer(rng, ci, co, 3)
        assert (
            relative_error(
                run_forward(dev, x, weight, bias, False, blocking=gpu), conv(x, weight, bias)
            )
            < 3e-6
        )
        expected = conv_gradients(x, weight, grad_out)[0]
        actual = run_backward_input(dev, x, weight, grad_out, False, blocking=gpu)
        assert relative_error(actual, expected) < 3e-6


@pytest.mark.large
def test_same_bits_twice(dev, rng):
    check_same_bits(dev, rng, run_forward)


def test_wrong_shapes_are_refused(dev):
    x, out = dev.zeros((4, 4, 16)), dev.zeros((4, 4, 32))
    weight, bias = dev.zeros((2, 3, 3, 16, 16)), dev.zeros(32)
    given = {"out": out, "relu": False, "blocking": SHIPPED["CPU"]}
    with pytest.raises(ValueError, match="16 \\+ 16 to 32 channels"):
        conv_forward(dev, (x, x), weight, bias, **given)
    with pytest.raises(ValueError, match="bias"):
        conv_forward(dev, (x,), weight, dev.zeros(16), **given)
    with pytest.raises(ValueError, match="width"):
        conv_forward(dev, (x,), weight, bias, **given | {"out": dev.zeros((4, 5, 32))})
    with pytest.raises(ValueError, match="flipped"):
        conv_backward_input(dev, weight, out, x, mask=None, blocking=SHIPPED["CPU"])


def test_relu_hides_no_nan(dev, rng):
    x = rng.normal(size=(5, 7, 16)).astype(np.float32)
    x[2, 3, 4] = np.nan
    out = dev.empty((5, 7, 16))
    weight, bias = pack_weights(rng.normal(size=(16, 16, 3, 3))), pack_bias(np.zeros(16))
    conv_forward(
        dev,
        (dev.upload(x),),
        dev.upload(weight),
        dev.upload(bias),
        out=out,
        relu=True,
        blocking=SHIPPED["CPU"],
    )
    bad = np.isnan(out.get()).all(axis=2)
    assert bad[1:4, 2:5].all() and bad.sum() == 9


def test_a_blocking_fits_the_channels_and_the_width():
    paired = replace(SHIPPED["CPU"], direct=(6, 2, (1, 1, 1)))
    assert paired.of_direct(100, 64) == paired.of_direct(6, 64) == (6, 2, (1, 1, 1))
    assert paired.of_direct(5, 64) == (4, 2, (1, 1, 1))
    assert paired.of_direct(3, 64) == (1, 2, (1, 1, 1))
    assert paired.of_direct(100, 48) == (12, 1, (1, 1, 1))  # three groups do not pair up
    single = replace(SHIPPED["CPU"], direct=(4, 1, (1, 1, 1)))
    assert single.of_direct(100, 48) == single.of_direct(100, 64) == (4, 1, (1, 1, 1))


def test_launches_in_parts_compute_the_same_bits(dev, rng, monkeypatch):
    x, grad_out = (rng.normal(size=(13, 30, c)).astype(np.float32) for c in (20, 32))
    weight, bias = layer(rng, 20, 32, 3)
    given = {"blocking": SHIPPED["GPU"]}
    launched = check_parts(
        dev, monkeypatch, "conv_forward", lambda: run_forward(dev, x, weight, bias, True, **given)
    )
    assert launched == 4  # groups of 4 rows
    launched = check_parts(
        dev,
        monkeypatch,
        "conv_backward_input",
        lambda: run_backward_input(dev, x, weight, grad_out, True, **given),
    )
    assert launched == 4
