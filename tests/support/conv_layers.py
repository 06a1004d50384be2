"""Convolution layers with random weights, and what every implementation of one is checked for."""

import numpy as np
from oracle.conv import conv, conv_gradients
from support.comparisons import relative_error
from support.guarded import large

# (height, width, channels in, channels out): tiles of every width, tails, channels beside the
# multiples of 16
SHAPES = [
    (1, 1, 3, 16),
    (1, 5, 16, 3),
    (5, 1, 20, 20),
    (3, 12, 1, 1),
    *map(
        large,
        [
            (31, 33, 16, 48),
            (257, 3, 32, 16),
            (6, 31, 3, 64),
            (4, 257, 48, 32),
            (8, 8, 512, 32),
            (16, 24, 32, 512),
        ],
    ),
]


# The same, and groups of 64 output channels, for kernels whose work-groups share local memory: a
# simulator takes half a minute for each.
LOCAL_SHAPES = [
    (1, 5, 16, 3),
    (5, 1, 20, 20),
    *map(
        large,
        [
            (1, 1, 3, 16),
            (3, 12, 1, 1),
            (31, 33, 16, 48),
            (257, 3, 32, 16),
            (6, 31, 3, 64),
            (4, 257, 48, 32),
            (8, 8, 512, 32),
            (16, 24, 32, 512),
            (5, 21, 36, 64),
        ],
    ),
]


def layer(rng, ci, co, k):
    """Random weights and bias of PyTorch's initial size: (CO, CI, K, K), (CO,)."""
    bound = 1 / np.sqrt(ci * k * k)
    return rng.uniform(-bound, bound, (co, ci, k, k)).astype(np.float32), rng.uniform(
        -bound, bound, co
    ).astype(np.float32)


def check_backward_input(dev, rng, shape, k, backward):
    """backward: run_backward_input of a kernel; shape: (height, width, channels in, channels
    out).
    """
    height, width, ci, co = shape
    x = np.maximum(rng.normal(size=(height, width, ci)), 0).astype(np.float32)
    weight, _ = layer(rng, ci, co, k)
    grad_out = rng.normal(size=(height, width, co)).astype(np.float32)
    expected = conv_gradients(x, weight, grad_out)[0]
    assert relative_error(backward(dev, x, weight, grad_out, False), expected) < 3e-6
    assert relative_error(backward(dev, x, weight, grad_out, True), expected * (x > 0)) < 3e-6


def check_hard_inputs(dev, rng, forward, backward):
    """Large means; nothing but zeros."""
    weight, bias = layer(rng, 16, 16, 3)
    offset = (1e3 + rng.normal(size=(13, 17, 16))).astype(np.float32)
    assert (
        relative_error(forward(dev, offset, weight, bias, False), conv(offset, weight, bias)) < 3e-6
    )
    zeros = np.zeros_like(offset)
    np.testing.assert_array_equal(
        forward(dev, zeros, weight, bias, False), np.broadcast_to(bias, zeros.shape)
    )
    # a ReLU at exactly 0 passes nothing
    assert not backward(dev, zeros, weight, offset, True).any()


def check_same_bits(dev, rng, forward):
    """In two runs."""
    x = rng.normal(size=(31, 50, 32)).astype(np.float32)
    weight, bias = layer(rng, 32, 48, 3)
    np.testing.assert_array_equal(
        forward(dev, x, weight, bias, True), forward(dev, x, weight, bias, True)
    )
