"""cl/layers/winograd.cl against float64."""

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from pp_cl.layers.winograd import winograd_backward_input, winograd_forward
from pp_cl.layers.winograd_transform import transform_flipped_weights
from pp_cl.reference.winograd import convolve
from support.comparisons import relative_error
from support.conv_layers import layer
from support.winograd_layers import (
    BOUNDS,
    SHAPES,
    form,
    run_forward,
    transformed_by_device,
    work_of,
)

from pp_cl.layers.choice import CHOICES, SHIPPED
from pp_cl.layers.conv import Work, pack_weights

HALF = form(4, half=True)


def run_backward_input(dev, form, x, weight, grad_out, *, masked, first=0):
    co, c = weight.shape[0], x.shape[2]
    work = work_of(dev, form, c, co)
    packed = dev.upload(pack_weights(weight))
    transform_flipped_weights(dev, form, packed, first, c=c, transformed=work.weights)
    grad_x = dev.empty(x.shape)
    mask = dev.upload(x) if masked else None
    winograd_backward_input(dev, form, dev.upload(grad_out), grad_x, mask=mask, work=work)
    return grad_x.get()


@pytest.mark.parametrize("m", BOUNDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_forward(dev, rng, shape, m):
    height, width, ci, co = shape
    x = rng.normal(size=(height, width, ci)).astype(np.float32)
    weight, bias = layer(rng, ci, co, 3)
    for relu in (False, True):
        assert (
            relative_error(
                run_forward(dev, form(m), x, weight, bias, relu=relu), conv(x, weight, bias, relu)
            )
            < BOUNDS[m]
        )


@pytest.mark.parametrize("m", BOUNDS)
@pytest.mark.parametrize("c1, c2", [(16, 16), (16, 48), (64, 32)])
def test_two_sources_are_a_concatenation(dev, rng, c1, c2, m):
    x = rng.normal(size=(7, 29, c1 + c2)).astype(np.float32)
    weight, bias = layer(rng, c1 + c2, 32, 3)
    actual = run_forward(
        dev,
        form(m),
        np.ascontiguousarray(x[..., :c1]),
        weight,
        bias,
        relu=True,
        x2=np.ascontiguousarray(x[..., c1:]),
    )
    assert relative_error(actual, conv(x, weight, bias, True)) < BOUNDS[m]


@pytest.mark.parametrize("m", BOUNDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_backward_input(dev, rng, shape, m):
    height, width, ci, co = shape
    x = np.maximum(rng.normal(size=(height, width, ci)), 0).astype(np.float32)
    weight, _ = layer(rng, ci, co, 3)
    grad_out = rng.normal(size=(height, width, co)).astype(np.float32)
    expected = conv_gradients(x, weight, grad_out)[0]
    assert (
        relative_error(
            run_backward_input(dev, form(m), x, weight, grad_out, masked=False), expected
        )
        < BOUNDS[m]
    )
    assert (
        relative_error(
            run_backward_input(dev, form(m), x, weight, grad_out, masked=True), expected * (x > 0)
        )
        < BOUNDS[m]
    )


@pytest.mark.parametrize("m", BOUNDS)
def test_backward_input_of_the_second_source(dev, rng, m):
    x2 = rng.normal(size=(9, 14, 48)).astype(np.float32)
    weight, _ = layer(rng, 16 + 48, 32, 3)
    grad_out = rng.normal(size=(9, 14, 32)).astype(np.float32)
    expected = conv_gradients(np.concatenate([np.zeros((9, 14, 16)), x2], 2), weight, grad_out)[0][
        ..., 16:
    ]
    assert (
        relative_error(
            run_backward_input(dev, form(m), x2, weight, grad_out, masked=False, first=16), expected
        )
        < BOUNDS[m]
    )


@pytest.mark.parametrize("m", BOUNDS)
def test_hard_inputs(dev, rng, m):
    weight, bias = layer(rng, 32, 32, 3)
    offset = (1e3 + rng.normal(size=(13, 17, 32))).astype(np.float32)
    assert (
        relative_error(
            run_forward(dev, form(m), offset, weight, bias, relu=False), conv(offset, weight, bias)
        )
        < BOUNDS[m]
    )
    zeros = np.zeros_like(offset)
    np.testing.assert_array_equal(
        run_forward(dev, form(m), zeros, weight, bias, relu=False),
        np.broadcast_to(bias, zeros.shape),
    )
    # a ReLU at exactly 0 passes nothing
    assert not run_backward_input(dev, form(m), zeros, weight, offset, masked=True).any()


@pytest.mark.parametrize("m", BOUNDS)
def test_weights_over_six_decades(dev, rng, m):
    """Each output channel keeps its own accuracy; among input channels the error is small against
    the largest.
    """
    x = rng.normal(size=(13, 17, 32)).astype(np.float32)
    decades = np.logspace(-3, 3, 32)
    weight, _ = layer(rng, 32, 32, 3)
    by_output = (weight * decades[:, None, None, None]).astype(np.float32)
    actual, expected = (
        run_forward(dev, form(m), x, by_output, np.zeros(32), relu=False),
        conv(x, by_output, np.zeros(32)),
    )
    for channel in range(32):
        assert relative_error(actual[..., channel], expected[..., channel]) < BOUNDS[m]
    by_input = (weight * decades[:, None, None]).astype(np.float32)
    assert (
        relative_error(
            run_forward(dev, form(m), x, by_input, np.zeros(32), relu=False),
            conv(x, by_input, np.zeros(32)),
        )
        < BOUNDS[m]
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_weights_stored_as_half_are_convolved_in_float32(dev, rng, shape):
    """Rounded weights are other weights (test_winograd_transform.py: which); from there on nothing
    more is rounded.
    """
    height, width, ci, co = shape
    x = np.maximum(rng.normal(size=(height, width, ci)), 0).astype(np.float32)
    weight, bias = layer(rng, ci, co, 3)
    grad_out = rng.normal(size=(height, width, co)).astype(np.float32)
    expected = np.maximum(convolve(4, x, transformed_by_device(dev, 4, True, weight)[1]) + bias, 0)
    assert relative_error(run_forward(dev, HALF, x, weight, bias, relu=True), expected) < BOUNDS[4]
    expected = convolve(
        4, grad_out, transformed_by_device(dev, 4, True, weight, True, 0, ci)[1]
    ) * (x > 0)
    assert (
        relative_error(run_backward_input(dev, HALF, x, weight, grad_out, masked=True), expected)
        < BOUNDS[4]
    )


def test_half_of_two_sources(dev, rng):
    x, x2 = (rng.normal(size=(9, 14, c)).astype(np.float32) for c in (16, 48))
    weight, bias = layer(rng, 16 + 48, 32, 3)
    grad_out = rng.normal(size=(9, 14, 32)).astype(np.float32)
    expected = (
        convolve(4, np.concatenate([x, x2], 2), transformed_by_device(dev, 4, True, weight)[1])
        + bias
    )
    assert (
        relative_error(run_forward(dev, HALF, x, weight, bias, relu=False, x2=x2), expected)
        < BOUNDS[4]
    )
    expected = convolve(4, grad_out, transformed_by_device(dev, 4, True, weight, True, 16, 48)[1])
    assert (
        relative_error(
            run_backward_input(dev, HALF, x2, weight, grad_out, masked=False, first=16), expected
        )
        < BOUNDS[4]
    )


@pytest.mark.large
@pytest.mark.parametrize("units", [1, 3, 100])
def test_same_bits_for_any_number_of_compute_units(dev, rng, monkeypatch, units):
    x = rng.normal(size=(31, 50, 32)).astype(np.float32)
    weight, bias = layer(rng, 32, 48, 3)
    expected = run_forward(dev, form(4), x, weight, bias, relu=True)
    monkeypatch.setitem(dev.info, "compute_units", units)
    np.testing.assert_array_equal(run_forward(dev, form(4), x, weight, bias, relu=True), expected)


@pytest.mark.parametrize("m", BOUNDS)
def test_relu_hides_no_nan(dev, rng, m):
    x = rng.normal(size=(9, 11, 16)).astype(np.float32)
    x[4, 5, 6] = np.nan
    weight, bias = layer(rng, 16, 16, 3)
    bad = np.isnan(run_forward(dev, form(m), x, weight, bias, relu=True)).all(axis=2)
    assert bad[3:6, 4:7].all()  # and more of the tiles that saw it
    assert not bad[:, 10].any()


def test_wrong_shapes_are_refused(dev):
    x, out, bias = dev.zeros((4, 4, 16)), dev.zeros((4, 4, 32)), dev.zeros(32)
    work = work_of(dev, form(4), 16, 32)

    def forward(*sources, bias=bias, out=out):
        winograd_forward(dev, form(4), sources, bias, out=out, relu=False, work=work)

    def backward(grad_out, work=work):
        winograd_backward_input(dev, form(4), grad_out, x, mask=None, work=work)

    with pytest.raises(ValueError, match="3 to 32 channels"):
        forward(dev.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="16 \\+ 20"):
        forward(x, dev.zeros((4, 4, 20)))
    with pytest.raises(ValueError, match="bias"):
        forward(x, bias=dev.zeros(16))
    with pytest.raises(ValueError, match="width"):
        forward(x, out=dev.zeros((4, 5, 32)))
    with pytest.raises(ValueError, match="transformed weights of"):
        forward(x, x)
    with pytest.raises(ValueError, match="scratch of 10 floats"):
        backward(out, Work(dev.zeros(10), work.weights))
    with pytest.raises(ValueError, match="from 20 channels"):
        backward(dev.zeros((4, 4, 20)))


def test_groups_divide_rounds():
    for field in ("winograd", "winograd_narrow"):
        assert all(tiles % group == 0 for tiles, group in CHOICES["CPU"][field])


def test_the_blocking_depends_on_the_channels():
    assert form(4).tiles_and_group(128, 128) == SHIPPED["CPU"].winograd_narrow
    assert form(4).tiles_and_group(128, 144) == SHIPPED["CPU"].winograd
