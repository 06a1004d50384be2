"""cl/layers/conv_local.cl against float64: what it does is what conv.cl does."""

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from support.comparisons import relative_error
from support.conv_layers import check_backward_input, check_hard_inputs, check_same_bits, layer
from support.guarded import large

from pp_cl.layers.conv import conv_backward_input, conv_forward, pack_bias, pack_weights
from pp_cl.layers.conv_backward_weights import flip_weights
from pp_cl.layers.conv_local import COLUMNS, ROWS
from pp_cl.layers.tiles import grid_shape, some_tiles

# (height, width, channels in, channels out): less than a work-group's pixels, tails of both kinds,
# half its channels
SHAPES = [
    (1, 1, 16, 16),
    (1, 5, 16, 32),
    large((ROWS, COLUMNS, 32, 32)),
    (ROWS + 1, COLUMNS + 1, 16, 48),
    *map(large, [(31, 33, 16, 48), (257, 3, 32, 16), (8, 8, 512, 32), (6, 17, 32, 512)]),
]


def run_forward(dev, x, weight, bias, relu, x2=None, tiles=None):
    out = dev.empty((*x.shape[:2], len(bias)))
    conv_forward(
        dev,
        dev.upload(x),
        dev.upload(pack_weights(weight)),
        dev.upload(pack_bias(bias)),
        out,
        relu,
        None if x2 is None else dev.upload(x2),
        tiles,
        local_memory=True,
    )
    return out.get()


def run_backward_input(dev, x, weight, grad_out, masked, first=0, tiles=None):
    co, _, k, _ = weight.shape
    flipped = dev.empty((x.shape[2] // 16, k, k, co, 16))
    flip_weights(dev, dev.upload(pack_weights(weight)), first, flipped)
    grad_x = dev.empty(x.shape)
    conv_backward_input(
        dev, dev.upload(x), flipped, dev.upload(grad_out), grad_x, masked, tiles, local_memory=True
    )
    return grad_x.get()


@pytest.mark.parametrize("shape", SHAPES)
def test_forward(dev, rng, shape):
    height, width, ci, co = shape
    x = rng.normal(size=(height, width, ci)).astype(np.float32)
    weight, bias = layer(rng, ci, co, 3)
    for relu in (False, True):
        assert (
            relative_error(run_forward(dev, x, weight, bias, relu), conv(x, weight, bias, relu))
            < 3e-6
        )


@pytest.mark.parametrize("c1, c2", [(16, 16), large(16, 48), large(64, 32)])
def test_two_sources_are_a_concatenation(dev, rng, c1, c2):
    x = rng.normal(size=(9, 29, c1 + c2)).astype(np.float32)
    weight, bias = layer(rng, c1 + c2, 48, 3)
    actual = run_forward(
        dev,
        np.ascontiguousarray(x[..., :c1]),
        weight,
        bias,
        True,
        np.ascontiguousarray(x[..., c1:]),
    )
    assert relative_error(actual, conv(x, weight, bias, True)) < 3e-6


@pytest.mark.parametrize("shape", SHAPES)
def test_backward_input(dev, rng, shape):
    check_backward_input(dev, rng, shape, 3, run_backward_input)


def test_backward_input_of_the_second_source(dev, rng):
    x2 = rng.normal(size=(9, 14, 48)).astype(np.float32)
    weight, _ = layer(rng, 16 + 48, 32, 3)
    grad_out = rng.normal(size=(9, 14, 32)).astype(np.float32)
    expected = conv_gradients(np.concatenate([np.zeros((9, 14, 16)), x2], 2), weight, grad_out)[0][
        ..., 16:
    ]
    assert (
        relative_error(run_backward_input(dev, x2, weight, grad_out, False, first=16), expected)
        < 3e-6
    )


def test_only_computed_tiles_are_written(dev, rng):
    """Of work-groups with all, some and none of their tiles to compute."""
    height, width = 21, 39
    x = rng.normal(size=(height, width, 16)).astype(np.float32)
    weight, bias = layer(rng, 16, 32, 3)
    grad_out = rng.normal(size=(height, width, 32)).astype(np.float32)
    count = (rng.random(grid_shape(height, width)) < 0.5).astype(int)
    count[:2, :4], count[2:4, 4:8], count[3, 3] = 1, 0, 0
    written = np.repeat(np.repeat(count, 4, 0), 4, 1)[:height, :width] > 0
    tiles = some_tiles(dev, (height, width), count)
    expected = {"out": conv(x, weight, bias), "grad_x": conv_gradients(x, weight, grad_out)[0]}
    actual = {
        "out": run_forward(dev, x, weight, bias, False, tiles=tiles),
        "grad_x": run_backward_input(dev, x, weight, grad_out, False, tiles=tiles),
    }
    for name in expected:
        assert relative_error(actual[name][written], expected[name][written]) < 3e-6
        assert np.isnan(actual[name][~written]).all()  # as the guarded device made it


def test_hard_inputs(dev, rng):
    check_hard_inputs(dev, rng, run_forward, run_backward_input)


@pytest.mark.large
def test_same_bits_twice(dev, rng):
    check_same_bits(dev, rng, run_forward)


def test_relu_hides_no_nan(dev, rng):
    x = rng.normal(size=(5, 7, 16)).astype(np.float32)
    x[2, 3, 4] = np.nan
    bad = np.isnan(run_forward(dev, x, rng.normal(size=(16, 16, 3, 3)), np.zeros(16), True)).all(
        axis=2
    )
    assert bad[1:4, 2:5].all() and bad.sum() == 9


def test_other_channels_are_refused(dev, rng):
    for ci, co in ((3, 16), (16, 20)):
        weight, bias = layer(rng, ci, co, 3)
        with pytest.raises(ValueError, match="multiples of 16"):
            run_forward(dev, np.zeros((4, 4, ci), np.float32), weight, bias, False)
