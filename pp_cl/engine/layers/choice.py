"""How a device computes convolutions: which variant (direct, Winograd or local) runs for a shape,
and the sizes that the kernels are built with. Both are shipped, by the kind of device and, for
CPUs, by the width of their vectors; `python -m tools.tune` measures a row of that table. And the
memory that the choice takes.
"""

import math
from collections.abc import Iterable
from typing import Any

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.layers import conv_direct, conv_local, conv_winograd
from pp_cl.engine.layers.conv import Blocking, Conv, ConvShape, packed_shape, parts_shape

AUTO = "auto"
# The modules have the same functions.
VARIANTS: dict[str, Any] = {
    "local": conv_local,
    "direct": conv_direct,
    "winograd": conv_winograd,
}
# {class of device: the variants that it is offered}. On GPUs "local" is 3 times as fast as "direct"
# (an NVIDIA H100); Winograd's groups would be one lane, and spill 15 KB of registers.
OFFERED = {"CPU": ("direct", "winograd"), "GPU": ("local", "direct")}
# {direction: pixels}: on CPUs Winograd runs in images of at least so many. It is 2.7 times as fast
# as direct in the paper's network at 256x256, on 2 cores with AVX-512. In smaller images too few
# tiles share the cost of transforming the weights; channels matter less, from 16 on all gain.
WINOGRAD_FROM = {"forward": 900, "input": 900, "weights": 64}

# AVX2 has 16 registers of 8 floats, which hold 8 vectors of 16: 4 sums, the weights of a row, and
# what they are multiplied with. Measured on Zen 3: 1.6 times (forward) and 1.75 times (training)
# the speed of the numbers for AVX-512.
_EIGHT_VECTORS = Blocking(
    direct=(4, 1, (1, 1, 1)),
    direct_odd=(4, 1, (1, 1, 1)),
    accumulators=4,
    work_group=(1, 1, 1),
    winograd_groups=1,
    winograd=(64, 4),
    winograd_narrow=(24, 4),
)
# {floats of a CPU's vectors: Blocking}
CPUS = {
    # AVX-512 has 32 registers of 16 floats. Where groups of 16 channels pair up, two share each
    # input value and take 8 pixels: 16 accumulators and 6 weights; else one takes 12.
    16: Blocking(
        direct=(8, 2, (1, 1, 1)),
        direct_odd=(12, 1, (1, 1, 1)),
        accumulators=24,
        work_group=(1, 1, 1),
        winograd_groups=2,
        winograd=(64, 8),
        winograd_narrow=(12, 12),
    ),
    8: _EIGHT_VECTORS,
    # Not measured: Arm's and Apple's 32 registers of 4 floats hold 8 vectors of 16, as AVX2's do.
    4: _EIGHT_VECTORS,
}
# A work-item has about 255 scalar registers, and a vector of 16 takes 16 of them: 4 pixels.
GPU = Blocking(
    direct=(4, 1, (16, 4, 1)),
    direct_odd=(4, 1, (16, 4, 1)),
    accumulators=6,
    work_group=None,
)


def device_class(dev: Device) -> str:
    """The key of a device in OFFERED: "CPU", or "GPU" for every other device."""
    return "CPU" if dev.is_cpu else "GPU"


def blocking_of(dev: Device) -> Blocking:
    """The shipped sizes of a device's kernels."""
    if not dev.is_cpu:
        return GPU
    width = dev.device.native_vector_width_float
    return CPUS[max((floats for floats in CPUS if floats <= width), default=min(CPUS))]


def can_run(variant: str, k: int, *channels: int) -> bool:
    """Whether a variant takes a K x K kernel and these numbers of channels, of each source and of
    the output.
    """
    return variant != "winograd" or (k == 3 and conv_winograd.fits(*channels))


def choose(dev: Device, shape: ConvShape, variant: str = AUTO) -> str:
    """What computes a convolution, of VARIANTS. variant: a name there is taken wherever it can run,
    "direct" elsewhere; AUTO takes the shipped choice. Raises ValueError for another variant.
    """
    if variant not in (AUTO, *VARIANTS):
        raise ValueError(f"variant {variant!r}: must be one of {', '.join((AUTO, *VARIANTS))}")
    if variant == AUTO and not dev.is_cpu:
        variant = "local"
    elif variant == AUTO:
        is_faster = math.prod(shape.size) >= WINOGRAD_FROM[shape.direction]
        variant = "winograd" if is_faster else "direct"
    return variant if can_run(variant, shape.k, *shape.sources, shape.co) else "direct"


def work_shape(variant: str, shape: ConvShape) -> tuple[int, ...] | None:
    """Of the float32 array that a convolution takes beside the layer's own, Conv.work: the weights
    as the kernels read them, None where they read them as they are; or the parts of the gradients.
    """
    if shape.direction == "weights":
        return parts_shape(VARIANTS[variant].parts_of(shape), shape)
    if variant == "winograd":
        return conv_winograd.transformed_shape(shape)
    return packed_shape(shape.k, shape.co, shape.ci) if shape.direction == "input" else None


def lay_out(dev: Device, convs: Iterable[Conv], weights: Array, work: Array) -> None:
    """Write the weights that convolutions read to Conv.work, in a launch for each kernel that does.

    weights, work: (?,) float32, in which Conv.weight and Conv.work lie.
    """
    laid_out = [conv for conv in convs if conv.shape.direction != "weights"]
    transformed = [conv for conv in laid_out if conv.variant == "winograd"]
    flipped = [c for c in laid_out if c.variant != "winograd" and c.shape.direction == "input"]
    if flipped:
        conv_direct.flip_weights(dev, flipped, weights, work)
    if transformed:
        conv_winograd.transform_weights(dev, transformed, weights, work)


def prepared(dev: Device, shape: ConvShape, weight: Array, bias: Array) -> Conv:
    """What computes a convolution by the shipped choice; its weights, which do not change, are laid
    out in an array of its own.
    """
    conv = Conv(dev, blocking_of(dev), choose(dev, shape), shape, weight, bias)
    needed = work_shape(conv.variant, shape)
    if needed:
        conv.work = dev.empty(needed)
        lay_out(dev, [conv], weight.reshape(-1), conv.work)
    return conv
