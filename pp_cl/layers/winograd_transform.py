"""Weights made ready for winograd.py's convolutions, in 32 bits or, as `half`, in 16.

Half the bytes are half the traffic of a layer whose weights outgrow the caches. Half's 11 bits cost
accuracy, but no range: each output channel's weights are scaled by a power of two of their own.
What they are multiplied with, and all sums, stay float32.
"""

from pp_cl.layers.conv import LANES
from pp_cl.layers.winograd import check_size, fits, transformed_floats


def transform_weights(dev, m, weight, transformed, half=False):
    """Fill transformed, of at least transformed_floats, from weight (CO/16, 3, 3, CI, 16) for
    winograd_forward.

    Raises ValueError when it is too small.
    """
    blocks, _, _, ci, _ = weight.shape
    program = _program(dev, m, ci, blocks * LANES, transformed, half)
    arguments = {"ci": ci, "blocks": blocks, "weight": weight, "transformed": transformed}
    if half:
        program.launch("winograd_units", blocks, local=1, **arguments)
    program.launch("winograd_weights", (ci, blocks), local=(LANES, 1), **arguments)


def transform_flipped_weights(dev, m, weight, first, c, transformed, half=False):
    """The same for winograd_backward_input to c input channels from `first` on, multiples of 16
    like all channels.
    """
    blocks, _, _, ci, _ = weight.shape
    co = blocks * LANES
    if not fits(c) or first % LANES or first + c > ci:
        raise ValueError(
            f"Winograd input gradient of {c} channels from {first} on: channels come in multiples"
            f" of {LANES}"
        )
    program = _program(dev, m, co, c, transformed, half)
    arguments = {
        "co": co,
        "blocks": c // LANES,
        "first": first,
        "ci": ci,
        "weight": weight,
        "transformed": transformed,
    }
    if half:
        program.launch("winograd_flipped_units", c, local=LANES, **arguments)
    program.launch("winograd_flipped_weights", (co, c // LANES), local=(LANES, 1), **arguments)


def _program(dev, m, ci, co, transformed, half):
    check_size("transformed weights", transformed, transformed_floats(m, ci, co, half))
    return dev.program("layers/winograd_transform", M=m, HALF=int(half))
