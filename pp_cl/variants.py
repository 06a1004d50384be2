"""The variants of a convolution behind one interface: forward pass, gradient of the input, gradients of weights and bias.

A variant is a name in VARIANTS. Winograd's take 3x3 kernels and channels in multiples of 16; `applicable` gives the direct
one for the others. Each call gets a Work, memory to work in, which several convolutions may share one after the other.
"""

import math
from dataclasses import dataclass

from pyopencl.array import Array

from pp_cl.conv import LANES, conv_backward_input, conv_forward
from pp_cl.conv_weights import flip_weights, partial_floats, weight_gradient
from pp_cl.winograd import (
    fits,
    scratch_floats,
    transformed_floats,
    winograd_backward_input,
    winograd_forward,
)
from pp_cl.winograd_filter import transform_flipped_weights, transform_weights
from pp_cl.winograd_weights import gradient_scratch_floats, winograd_weight_gradient

# By name: the side m of Winograd's tiles of outputs, None for the direct convolution; whether weights are stored as half.
VARIANTS = {"direct": (None, False), "winograd2": (2, False), "winograd4": (4, False), "winograd4_half": (4, True)}
# By what is computed: the variants that are fastest from so many pixels on, measured on 2 cores with AVX-512. Below, too few
# tiles share the cost of transforming the weights. Channels matter less: from 16 on, all of them gain. Half's is for those
# who ask for it: faster from 512 channels on, at several hundred times the error.
FASTEST = {
    "forward": ((900, "winograd4"), (256, "winograd2"), (0, "direct")),
    "input": ((900, "winograd4"), (256, "winograd2"), (0, "direct")),
    "weights": ((64, "winograd4"), (0, "direct")),
}


@dataclass
class Work:
    """Device memory for convolutions to work in."""

    scratch: Array  # float32, any number of floats that suffices
    weights: Array  # weights as a kernel wants them


def work_floats(dev, variant, direction, height, weight_shape, c=None):
    """(floats of Work.scratch, floats of Work.weights) that a convolution of an image `height` high needs.

    weight_shape: (ceil(CO/16), K, K, CI, 16); c: the input channels of a gradient of the input.
    """
    m, half = VARIANTS[variant]
    blocks, k, _, ci, _ = weight_shape
    if direction == "weights":
        return partial_floats(height, weight_shape) if m is None else gradient_scratch_floats(dev, m), 0
    ci, co = c or ci, blocks * LANES
    if m:
        return scratch_floats(dev, m, ci, co), transformed_floats(m, ci, co, half)
    return 0, math.prod(_flipped_shape(weight_shape, c, co)) if direction == "input" else 0


def applicable(variant, k, *channels):
    """`variant`, or "direct" where it cannot take a K x K kernel or these numbers of channels."""
    return variant if k == 3 and fits(*channels) else "direct"


def pick_variant(dev, direction, ci, co, height, width):
    """The variant that is shipped as the fastest for a 3x3 convolution of ci to co channels; direction: a key of FASTEST."""
    if not dev.is_cpu:
        return "direct"
    return applicable(next(name for pixels, name in FASTEST[direction] if height * width >= pixels), 3, ci, co)


def lay_out(dev, variant, weight):
    """Weights as forward() lays them out each time, in an array of their own; None where it takes them as they are."""
    (m, half), (blocks, _, _, ci, _) = VARIANTS[variant], weight.shape
    if m is None:
        return None
    laid_out = dev.empty(transformed_floats(m, ci, blocks * LANES, half))
    transform_weights(dev, m, weight, laid_out, half)
    return laid_out


def forward(dev, variant, x, weight, bias, out, relu, work, x2=None, tiles=None, laid_out=None):
    """conv.conv_forward by a variant. laid_out: lay_out(variant, weight), if it is there already."""
    m, half = VARIANTS[variant]
    if m is None:
        conv_forward(dev, x, weight, bias, out, relu, x2, tiles)
        return
    if laid_out is None:
        laid_out = work.weights
        transform_weights(dev, m, weight, laid_out, half)
    winograd_forward(dev, m, x, laid_out, bias, out, relu, work.scratch, x2, half, tiles)


def backward_input(dev, variant, x, weight, first, grad_out, grad_x, masked, work, tiles=None):
    """conv.conv_backward_input by a variant; weight as in forward, `first`: the channel of it where x begins."""
    m, half = VARIANTS[variant]
    c, co = grad_x.shape[2], grad_out.shape[2]
    if m is None:
        shape = _flipped_shape(weight.shape, c, co)
        flipped = work.weights[:math.prod(shape)].reshape(shape)
        flip_weights(dev, weight, first, flipped)
        conv_backward_input(dev, x, flipped, grad_out, grad_x, masked, tiles)
    else:
        transform_flipped_weights(dev, m, weight, first, c, work.weights, half)
        winograd_backward_input(dev, m, x, work.weights, grad_out, grad_x, masked, work.scratch, half, tiles)


def backward_weights(dev, variant, x, grad_out, grad_weight, grad_bias, work, x2=None, tiles=None):
    """conv_weights.weight_gradient by a variant; it reads no weights, so that half changes nothing."""
    m, _ = VARIANTS[variant]
    if m is None:
        weight_gradient(dev, x, grad_out, grad_weight, grad_bias, work.scratch, x2, tiles)
    else:
        winograd_weight_gradient(dev, m, x, grad_out, grad_weight, grad_bias, work.scratch, x2, tiles)


def _flipped_shape(weight_shape, c, co):
    """Shape of the flipped weights of c input channels."""
    return -(-c // LANES), *weight_shape[1:3], co, LANES
