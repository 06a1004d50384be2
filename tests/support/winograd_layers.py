"""Winograd convolutions run on plain arrays."""

import numpy as np
from pp_cl.layers.winograd import WinogradForm, winograd_forward
from pp_cl.layers.winograd_backward_weights import (
    backward_weights_floats,
    winograd_backward_weights,
)
from pp_cl.layers.winograd_transform import transform_flipped_weights, transform_weights
from support.guarded import large

from pp_cl.layers.choice import SHIPPED
from pp_cl.layers.conv import Blocking, Work, pack_bias, pack_weights, unpack_weights


def form(m, half=False, blocking: Blocking = SHIPPED["CPU"]):
    """The WinogradForm of F(m x m, 3 x 3)."""
    return WinogradForm(
        m, half, blocking.winograd, blocking.winograd_narrow, blocking.winograd_weights
    )


def stored_weights(array, m, ci, co, half):
    """(units (CO,), transformed weights (S, S, CO, CI)) in float64 from what cl/layers/winograd.h
    lays out.
    """
    array = array.get()
    units, weights = (array[:co], array[co:].view(np.float16)) if half else (np.ones(co), array)
    weights = weights[: (m + 2) ** 2 * (ci * co + 16)].reshape(m + 2, m + 2, -1)[..., :-16]
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
    transformed = dev.empty(form(m, half).transformed_floats(ci, co))
    packed = dev.upload(pack_weights(weight))
    if flip:
        transform_flipped_weights(dev, form(m, half), packed, first, c=c, transformed=transformed)
    else:
        transform_weights(dev, form(m, half), packed, transformed)
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


def work_of(dev, form, ci, co):
    """As much work memory as a convolution of ci to co channels needs."""
    return Work.empty(dev, form.scratch_floats(dev, ci, co), form.transformed_floats(ci, co))


def run_forward(dev, form, x, weight, bias, *, relu, x2=None):
    """(H, W, CO) by the device; form: WinogradForm."""
    co, ci = weight.shape[:2]
    out, work = dev.empty((*x.shape[:2], co)), work_of(dev, form, ci, co)
    transform_weights(dev, form, dev.upload(pack_weights(weight)), work.weights)
    sources = tuple(dev.upload(source) for source in (x, x2) if source is not None)
    bias = dev.upload(pack_bias(bias))
    winograd_forward(dev, form, sources, bias, out=out, relu=relu, work=work)
    return out.get()


def run_backward_weights(dev, form, grad_out, *sources):
    """((CO, CI, 3, 3), (CO,)) gradients by the device; form: WinogradForm."""
    co, ci = grad_out.shape[2], sum(s.shape[2] for s in sources)
    grad_weight, grad_bias = dev.empty((co // 16, 3, 3, ci, 16)), dev.empty(co)
    winograd_backward_weights(
        dev,
        form,
        tuple(dev.upload(s) for s in sources),
        dev.upload(grad_out),
        grad_weight=grad_weight,
        grad_bias=grad_bias,
        work=Work.empty(dev, *backward_weights_floats(dev, form, grad_weight.shape)),
    )
    return unpack_weights(grad_weight.get(), co), grad_bias.get()
