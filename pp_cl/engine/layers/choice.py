"""How a device computes convolutions: which variant (direct, Winograd or local) runs for a shape,
which sizes the kernels are built with, and how much memory this takes. Variants and sizes are
shipped by the kind of device and, for CPUs, by the width of their vectors; `python -m tools.tune`
measures a row of that table.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes
from pp_cl.engine.layers import conv_direct, conv_local, conv_winograd
from pp_cl.engine.layers.conv import (
    Blocking,
    Conv,
    ConvShape,
    column_macros,
    first_float,
    packed_shape,
    parts_shape,
)
from pp_cl.engine.layers.tiles import VECTOR

AUTO = "auto"
# The modules have the same functions.
VARIANTS: dict[str, Any] = {
    "local": conv_local,
    "direct": conv_direct,
    "winograd": conv_winograd,
}
# {class of device: the variants that suit it}. On GPUs "local" is 3 times as fast as "direct" (an
# NVIDIA H100); Winograd would run in groups of one lane, and spill 15 KB of registers.
OFFERED = {"CPU": ("direct", "winograd"), "GPU": ("local", "direct")}
# {direction: pixels}: CPUs use Winograd for images of at least this many pixels. It is 2.7 times as
# fast as direct in the paper's network at 256x256, on 2 cores with AVX-512. In smaller images too
# few tiles share the cost of transforming the weights; channels matter less: 16 or more all gain.
# The gradients of the weights, half of a backward pass, gain from 64 pixels on.
WINOGRAD_FROM = {"forward": 900, "backward": 400}

# AVX2 has 16 registers of 8 floats, which hold 8 vectors of 16: 4 sums, the weights of a row, and
# their factors. On Zen 3 this is 1.6 times (forward) and 1.75 times (training) as fast as the sizes
# for AVX-512.
_EIGHT_VECTORS = Blocking(
    direct=(4, 1),
    direct_odd=(4, 1),
    accumulators=4,
    work_group=(1, 1, 1),
    winograd_groups=1,
    winograd=(64, 4),
    winograd_narrow=(24, 4),
)
# {floats of a CPU's vectors: Blocking}
CPUS = {
    # AVX-512 has 32 registers of 16 floats. If groups of 16 channels pair up, two share each input
    # value and compute 8 pixels: 16 accumulators and 6 weights; otherwise one computes 12.
    16: Blocking(
        direct=(8, 2),
        direct_odd=(12, 1),
        accumulators=24,
        work_group=(1, 1, 1),
        winograd_groups=2,
        winograd=(64, 8),
        winograd_narrow=(12, 12),
    ),
    8: _EIGHT_VECTORS,
    # Not measured: Arm's and Apple's 32 registers of 4 floats hold 8 vectors of 16, like AVX2's.
    4: _EIGHT_VECTORS,
}
# A work-item has about 255 scalar registers, and a vector of 16 takes 16 of them, so it
# computes 4 pixels.
GPU = Blocking(
    direct=(4, 1),
    direct_odd=(4, 1),
    accumulators=6,
    work_group=None,
)


def device_class(dev: Device) -> str:
    """The key of a device in OFFERED: "CPU", or "GPU" for every other device."""
    return "CPU" if dev.is_cpu else "GPU"


def blocking_of(dev: Device) -> Blocking:
    """The shipped kernel sizes for a device."""
    if not dev.is_cpu:
        return GPU
    width = dev.device.native_vector_width_float
    return CPUS[max((floats for floats in CPUS if floats <= width), default=min(CPUS))]


def can_run(variant: str, k: int, *channels: int) -> bool:
    """Whether a variant supports a K x K kernel and these numbers of channels, of each source and
    of the output.
    """
    return variant != "winograd" or (k == 3 and conv_winograd.fits(*channels))


def choose(dev: Device, shape: ConvShape, variant: str = AUTO) -> str:
    """Choose the variant, a key of VARIANTS, that computes a convolution. variant: this one
    wherever it can run, otherwise "direct"; AUTO: the shipped choice. Raises ValueError for an
    unknown variant.
    """
    if variant not in (AUTO, *VARIANTS):
        raise ValueError(f"variant {variant!r}: must be one of {', '.join((AUTO, *VARIANTS))}")
    if variant == AUTO and not dev.is_cpu:
        variant = "local"
    elif variant == AUTO:
        is_faster = math.prod(shape.size) >= WINOGRAD_FROM[shape.direction]
        variant = "winograd" if is_faster else "direct"
    return variant if can_run(variant, shape.k, *shape.sources, shape.co) else "direct"


def work_table(variant: str, shape: ConvShape) -> Table:
    """The arrays that a convolution needs besides the layer's own: "work" and "partial" of Conv, or
    neither.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    if shape.direction == "backward":
        shapes["work"] = packed_shape(shape.k, shape.co, VECTOR * sum(_blocks(shape.sources)))
        shapes["partial"] = parts_shape(VARIANTS[variant].parts_of(shape), shape)
    if variant == "winograd":
        shapes["work"] = conv_winograd.transformed_shape(shape)
    return {name: (of_array, np.float32) for name, of_array in shapes.items()}


class WeightsRow(NamedTuple):
    """A row of the table of lay_out(): cl/layers/weights.cl says what its columns are."""

    item: int
    kind: int
    taps: int
    read: int
    made: int
    first: int
    ci: int
    weight: int
    out: int
    halved: int


def lay_out(dev: Device, convs: Iterable[Conv], weights: Array, work: Array) -> None:
    """Write the weights in the layout that convolutions read to Conv.work, in one launch.

    weights, work: (?,) float32, the arrays that contain Conv.weight and Conv.work.
    """
    rows, n = [], 0
    for conv in convs:
        shape = conv.shape
        weight, out = first_float(conv.weight), first_float(conv.work) // VECTOR
        k, ci, co, is_forward = shape.k, shape.ci, shape.co, shape.direction == "forward"
        halved = conv.is_halved and not is_forward
        if conv.variant == "winograd":
            kind, read, made = (1, ci, co) if is_forward else (2, co, ci)
            rows.append(WeightsRow(n, kind, k**2, read, made, 0, ci, weight, out, halved))
            n += read * made // VECTOR
        elif not is_forward:
            first = 0
            for channels, blocks in zip(shape.sources, _blocks(shape.sources), strict=True):
                rows.append(WeightsRow(n, 0, k**2, co, channels, first, ci, weight, out, halved))
                vectors = blocks * k**2 * co
                n, first, out = n + vectors, first + channels, out + vectors
    if rows:
        # without Winograd's transforms where GPUs do not need them: they spill registers there
        transforms = int(dev.is_cpu or any(row.kind > 0 for row in rows))
        macros = {"LANES": lanes(dev), "WINOGRAD": transforms} | column_macros("ROW", WeightsRow)
        dev.program("layers/weights", **macros).launch(
            "lay_out_weights",
            n,
            VECTOR if dev.is_cpu else None,
            n=n,
            rows=len(rows),
            table=dev.constant(rows),
            weights=weights,
            laid_out=work,
        )


def _blocks(channels):
    """Groups of 16 in each of these numbers of channels."""
    return [-(-c // VECTOR) for c in channels]


def prepared(dev: Device, shape: ConvShape, weight: Array, bias: Array) -> Conv:
    """A Conv that computes a convolution's output by the shipped choice; its weights, which do not
    change, are laid out in an array of its own.
    """
    conv = Conv(dev, blocking_of(dev), choose(dev, shape), shape, weight, bias)
    for row in work_table(conv.variant, shape).values():
        conv.work = dev.empty(*row)
        lay_out(dev, [conv], weight.reshape(-1), conv.work)
    return conv
