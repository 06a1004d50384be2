"""Winograd convolutions run on plain arrays."""

import numpy as np
from support.guarded import large

from pp_cl.layers.conv import pack_bias, pack_weights, unpack_weights
from pp_cl.layers.winograd import (
    positions,
    scratch_floats,
    transformed_floats,
    winograd_forward,
)
from pp_cl.layers.winograd_backward_weights import gradient_scratch_floats, winograd_weight_gradient
from pp_cl.layers.winograd_transform import transform_flipped_weights, transform_weights


def stored_weights(array, m, ci, co, half):
    """(units (CO,), transformed weights (S, S, CO, CI)) in float64 from what cl/layers/winograd.h
    lays out.
    """
    array = array.get()
    units, weights = (array[:co], array[co:].view(np.float16)) if half else (np.ones(co), array)
    weights = weights[: positions(m) * (ci * co + 16)].reshape(m + 2, m + 2, -1)[..., :-16]
    weights = weights.reshape(m + 2, m + 2, co // 16, ci, 16)
    return units.astype(np.float64), weights.swapaxes(3, 4).reshape(
        m + 2, m + 2, co, ci
    ) * units.astype(np.float64)[:, None]


def transformed_by_device(dev, m, half, weight, flip=False, first=0, c=None):
    """stored_weights of weight (CO, CI, 3, 3); flip: for the gradient of c input channels from
    `first` on.
    """
    co, ci = weight.shape[:2]
    ci, co = (co, c) if flip else (ci, co)
    transformed = dev.empty(transformed_floats(m, ci, co, half))
    if flip:
        transform_flipped_weights(
            dev, m, dev.upload(pack_weights(weight)), first, c, transformed, half
        )
    else:
        transform_weights(dev, m, dev.upload(pack_weights(weight)), transformed, half)
    return stored_weights(transformed, m, ci, co, half)


# (height, width, channels in, channels out): less than a tile, tails of tiles, groups and rounds,
# odd blocks of channels
SHAPES = [
    (1, 1, 16, 16),
    (1, 5, 16, 32),
    (5, 1, 32, 48),
    (31, 33, 16, 48),
    *map(
        large,
        [(257, 3, 32, 16), (6, 31, 48, 64), (4, 257, 64, 32), (8, 8, 512, 32), (16, 24, 32, 512)],
    ),
]


# Float32's largest error over the largest value; F(4x4)'s transforms cost more of it than the sums
# do.
BOUNDS = {2: 3e-6, 4: 8e-6}


def run_forward(dev, m, x, weight, bias, relu, x2=None, half=False):
    co, ci = weight.shape[:2]
    out, transformed = dev.empty((*x.shape[:2], co)), dev.empty(transformed_floats(m, ci, co, half))
    transform_weights(dev, m, dev.upload(pack_weights(weight)), transformed, half)
    winograd_forward(
        dev,
        m,
        dev.upload(x),
        transformed,
        dev.upload(pack_bias(bias)),
        out,
        relu,
        dev.empty(scratch_floats(dev, m, ci, co)),
        None if x2 is None else dev.upload(x2),
        half,
    )
    return out.get()


def run_weight_gradient(dev, m, grad_out, *sources):
    co, ci = grad_out.shape[2], sum(s.shape[2] for s in sources)
    grad_weight, grad_bias = dev.empty((co // 16, 3, 3, ci, 16)), dev.empty(co)
    winograd_weight_gradient(
        dev,
        m,
        dev.upload(sources[0]),
        dev.upload(grad_out),
        grad_weight,
        grad_bias,
        dev.empty(gradient_scratch_floats(dev, m)),
        *[dev.upload(s) for s in sources[1:]],
    )
    return unpack_weights(grad_weight.get(), co), grad_bias.get()
