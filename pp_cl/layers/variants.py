"""The variants of a convolution behind one interface: forward pass, gradient of the input,
gradients of weights and bias.

A variant is a name in VARIANTS. Winograd's take 3x3 kernels and channels in multiples of 16;
`applicable` gives the direct one for the others. Each call gets a Work, memory to work in, which
several convolutions may share one after the other.
"""

import math
from dataclasses import dataclass

from pyopencl.array import Array

from pp_cl.layers.conv import LANES, conv_backward_input, conv_forward
from pp_cl.layers.conv_backward_weights import flip_weights, partial_floats, weight_gradient
from pp_cl.layers.winograd import (
    fits,
    scratch_floats,
    transformed_floats,
    winograd_backward_input,
    winograd_forward,
)
from pp_cl.layers.winograd_backward_weights import gradient_scratch_floats, winograd_weight_gradient
from pp_cl.layers.winograd_transform import transform_flipped_weights, transform_weights

# By name: the side m of Winograd's tiles of outputs, None for the direct convolutions, of which
# "local" goes through local memory; whether weights are stored as half.
VARIANTS = {
    "direct": (None, False),
    "winograd2": (2, False),
    "winograd4": (4, False),
    "winograd4_half": (4, True),
    "local": (None, False),
}
# By what is computed: the variants that are fastest from so many pixels on, measured on 2 cores
# with AVX-512. Below, too few tiles share the cost of transforming the weights. Channels matter
# less: from 16 on, all of them gain. Half's is for those who ask for it: faster from 512 channels
# on, at several hundred times the error.
FASTEST = {
    "forward": ((900, "winograd4"), (256, "winograd2"), (0, "direct")),
    "input": ((900, "winograd4"), (256, "winograd2"), (0, "direct")),
    "weights": ((64, "winograd4"), (0, "direct")),
}
# By what is computed: a bound on the relative L2 errors of 3x3 layers that bench_layer.py measured,
# of a ReLU's outputs or normal gradients, with up to 512 channels and 800 x 800 pixels; then of 1x1
# layers. docs/convolutions.md has hard inputs. For the weights, "local" and half have no kernels of
# their own.
ERRORS = {
    "forward": {
        "direct": 9e-7,
        "winograd2": 7e-7,
        "winograd4": 2.2e-6,
        "winograd4_half": 1.5e-3,
        "local": 9e-7,
    },
    "input": {
        "direct": 1.3e-6,
        "winograd2": 8e-7,
        "winograd4": 2.6e-6,
        "winograd4_half": 1.5e-3,
        "local": 1.3e-6,
    },
    "weights": {"direct": 3.5e-7, "winograd2": 4e-7, "winograd4": 8.5e-7},
}
ERRORS_1X1 = {"forward": 3.5e-7, "input": 4.5e-7, "weights": 4e-7}


@dataclass
class Work:
    """Device memory for convolutions to work in."""

    scratch: Array  # float32, any number of floats that suffices
    weights: Array  # weights as a kernel wants them

    def grow(self, dev, scratch, weights):
        """Make room for as many floats, if there is less."""
        for name, floats in (("scratch", scratch), ("weights", weights)):
            if getattr(self, name).size < floats:
                setattr(self, name, None)  # the old one goes before the new one comes
                setattr(self, name, dev.empty(floats))


def work_floats(dev, variant, direction, height, weight_shape, c=None):
    """(floats of Work.scratch, floats of Work.weights) that a convolution of an image `height` high
    needs.

    weight_shape: (ceil(CO/16), K, K, CI, 16); c: the input channels of a gradient of the input.
    """
    m, half = VARIANTS[variant]
    blocks, k, _, ci, _ = weight_shape
    if direction == "weights":
        return partial_floats(height, weight_shape) if m is None else gradient_scratch_floats(
            dev, m
        ), 0
    ci, co = c or ci, blocks * LANES
    if m:
        return scratch_floats(dev, m, ci, co), transformed_floats(m, ci, co, half)
    return 0, math.prod(_flipped_shape(weight_shape, c, co)) if direction == "input" else 0


def applicable(variant, k, *channels):
    """`variant`, or "direct" where it cannot take a K x K kernel or these numbers of channels."""
    return variant if k == 3 and fits(*channels) else "direct"


def offered(dev):
    """The variants worth trying on a class of devices: what a CPU calls local memory is no faster
    than the rest.
    """
    return [name for name in VARIANTS if not (dev.is_cpu and name == "local")]


def shipped_order(dev, direction, k, channels, pixels):
    """The variants that can take a convolution and have a kernel of their own for it, the shipped
    choice first.

    direction: a key of FASTEST; channels: of each source and of the output; pixels: of the image.
    """
    names = offered(dev)  # "direct" first: what a GPU takes, where nobody has measured yet
    if dev.is_cpu:
        first = [name for least, name in FASTEST[direction] if pixels >= least]
        names = list(dict.fromkeys([*first, *names]))
    return [
        name
        for name in names
        if name in ERRORS[direction] and applicable(name, k, *channels) == name
    ]


def pick_variant(dev, direction, ci, co, height, width, k=3, sources=()):
    """The variant for a K x K convolution of ci to co channels: as tuned for the device, else the
    shipped choice.

    direction: a key of FASTEST; sources: the channels of each source, where the convolution reads
    two. Raises UserError where no variant is as exact as the tolerance that the device was given.
    """
    order = shipped_order(dev, direction, k, (*(sources or (ci,)), co), height * width)
    return dev.tuning.pick(direction, k, ci, co, height * width, order) if dev.tuning else order[0]


def lay_out(dev, variant, weight):
    """Weights as forward() lays them out each time, in an array of their own; None where it takes
    them as they are.
    """
    (m, half), (blocks, _, _, ci, _) = VARIANTS[variant], weight.shape
    if m is None:
        return None
    laid_out = dev.empty(transformed_floats(m, ci, blocks * LANES, half))
    transform_weights(dev, m, weight, laid_out, half)
    return laid_out


def forward(dev, variant, x, weight, bias, out, relu, work, x2=None, tiles=None, laid_out=None):
    """conv.conv_forward by a variant. laid_out: lay_out(variant, weight), if it is there
    already.
    """
    m, half = VARIANTS[variant]
    if m is None:
        conv_forward(dev, x, weight, bias, out, relu, x2, tiles, variant == "local")
        return
    if laid_out is None:
        laid_out = work.weights
        transform_weights(dev, m, weight, laid_out, half)
    winograd_forward(dev, m, x, laid_out, bias, out, relu, work.scratch, x2, half, tiles)


def backward_input(dev, variant, x, weight, first, grad_out, grad_x, masked, work, tiles=None):
    """conv.conv_backward_input by a variant; weight as in forward, `first`: the channel of it where
    x begins.
    """
    m, half = VARIANTS[variant]
    c, co = grad_x.shape[2], grad_out.shape[2]
    if m is None:
        shape = _flipped_shape(weight.shape, c, co)
        flipped = work.weights[: math.prod(shape)].reshape(shape)
        flip_weights(dev, weight, first, flipped)
        conv_backward_input(dev, x, flipped, grad_out, grad_x, masked, tiles, variant == "local")
    else:
        transform_flipped_weights(dev, m, weight, first, c, work.weights, half)
        winograd_backward_input(
            dev, m, x, work.weights, grad_out, grad_x, masked, work.scratch, half, tiles
        )


def backward_weights(dev, variant, x, grad_out, grad_weight, grad_bias, work, x2=None, tiles=None):
    """conv_weights.weight_gradient by a variant; half changes nothing, as it reads no weights, and
    "local" is direct.
    """
    m, _ = VARIANTS[variant]
    if m is None:
        weight_gradient(dev, x, grad_out, grad_weight, grad_bias, work.scratch, x2, tiles)
    else:
        winograd_weight_gradient(
            dev, m, x, grad_out, grad_weight, grad_bias, work.scratch, x2, tiles
        )


def _flipped_shape(weight_shape, c, co):
    """Shape of the flipped weights of c input channels."""
    return -(-c // LANES), *weight_shape[1:3], co, LANES
