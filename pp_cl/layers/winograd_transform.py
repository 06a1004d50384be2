"""Weights transformed for winograd.py's convolutions, stored in 32 bits or, by form.half, in 16.

Half the bytes are half the traffic of a layer whose weights outgrow the caches. Half's 11 bits cost
accuracy, but no range: each output channel's weights are scaled by a power of two of their own. The
inputs that they are multiplied with, and all sums, stay float32.
"""

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.tiles import LANES
from pp_cl.layers.winograd import WinogradForm, check_size, fits


def transform_weights(dev: Device, form: WinogradForm, weight: Array, transformed: Array) -> None:
    """Fill transformed, of at least form.transformed_floats, from weight (CO/16, 3, 3, CI, 16) for
    winograd_forward.

    Raises ValueError when transformed is too small.
    """
    blocks, _, _, ci, _ = weight.shape
    program = _program(dev, form, (ci, blocks * LANES), transformed)
    arguments = {"ci": ci, "blocks": blocks, "weight": weight, "transformed": transformed}
    if form.half:
        program.launch("winograd_transform_units", blocks, local=1, **arguments)
    program.launch("winograd_transform_weights", (ci, blocks), local=(LANES, 1), **arguments)


def transform_flipped_weights(
    dev: Device, form: WinogradForm, weight: Array, first: int, *, c: int, transformed: Array
) -> None:
    """Fill transformed for winograd_backward_input to the c input channels from `first` on.

    Raises ValueError when transformed is too small, and for channels that are no multiples of 16.
    """
    blocks, _, _, ci, _ = weight.shape
    co = blocks * LANES
    if not fits(c) or first % LANES or first + c > ci:
        raise ValueError(
            f"Winograd input gradient of {c} channels from {first} on: channels come in multiples"
            f" of {LANES}"
        )
    program = _program(dev, form, (co, c), transformed)
    arguments = {
        "co": co,
        "blocks": c // LANES,
        "first": first,
        "ci": ci,
        "weight": weight,
        "transformed": transformed,
    }
    if form.half:
        program.launch("winograd_transform_flipped_units", c, local=LANES, **arguments)
    program.launch(
        "winograd_transform_flipped_weights", (co, c // LANES), local=(LANES, 1), **arguments
    )


def _program(dev, form, channels, transformed):
    check_size("transformed weights", transformed, form.transformed_floats(*channels))
    return dev.program("layers/winograd_transform", WINO_M=form.m, HALF=int(form.half))
