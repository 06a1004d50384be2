"""The registry of convolution variants: one row each, with its measured error and the device that
prefers it, and the interface that all of them have.
"""

from dataclasses import dataclass
from typing import Protocol

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.blocking import Blocking
from pp_cl.layers.direction import Direction
from pp_cl.layers.tiles import Tiles
from pp_cl.layers.variant_direct import DirectConvolution
from pp_cl.layers.variant_local import LocalConvolution
from pp_cl.layers.variant_winograd import WinogradConvolution
from pp_cl.layers.variant_winograd_gemm import WinogradGemmConvolution
from pp_cl.layers.winograd import WinogradForm, fits
from pp_cl.layers.work import Work

FORWARD, INPUT, WEIGHTS = Direction


@dataclass(frozen=True)
class Variant:
    """One way to compute a convolution.

    winograd_m: side of Winograd's tiles of outputs, None for the direct convolution. half:
    transformed weights are stored in 16 bits. errors: {K: {direction: bound on the relative L2
    errors that `pp-cl bench conv` measured for K x K layers, of a ReLU's outputs or normal
    gradients, with up to 512 channels and 800 x 800 pixels}}; docs/convolutions.md has hard inputs.
    A direction without an error has no kernel of its own. devices: classes of devices that it is
    offered to; the first in VARIANTS of those that a GPU is offered is shipped there. shipped_from:
    {direction: on CPUs, shipped for images of at least that many pixels}. preferred: the device
    that prefers it, and the measurement that says so. local: through local memory.
    """

    winograd_m: int | None
    half: bool
    errors: dict[int, dict[Direction, float]]
    devices: tuple[str, ...]
    shipped_from: dict[Direction, int]
    preferred: str
    local: bool = False

    def can_run(self, k: int, *channels: int) -> bool:
        """Whether it takes a K x K kernel and these numbers of channels, of each source and of the
        output.
        """
        return k in self.errors and (self.winograd_m is None or fits(*channels))

    def convolution(self, dev: Device, blocking: Blocking) -> "Convolution":
        """Its implementation on a device."""
        if self.winograd_m is None:
            return (LocalConvolution if self.local else DirectConvolution)(dev, blocking)
        if self.local:
            return WinogradGemmConvolution(dev, blocking, self.winograd_m)
        form = WinogradForm(
            self.winograd_m,
            self.half,
            blocking.winograd,
            blocking.winograd_narrow,
            blocking.winograd_weights,
        )
        return WinogradConvolution(dev, form)


# Below the least numbers of pixels too few tiles share the cost of transforming the weights.
# Channels matter less: from 16 on, all of them gain. The Winograd variants of CPUs are not offered
# to GPUs: a work-item holds a group of one lane, and GPU compilers spill 15 KB of its registers.
VARIANTS = {
    "local": Variant(
        None,
        False,
        {
            3: {FORWARD: 9e-7, INPUT: 1.3e-6, WEIGHTS: 3.5e-7},
            1: {FORWARD: 3.5e-7, INPUT: 4.5e-7, WEIGHTS: 4e-7},
        },
        ("GPU",),
        {},
        "GPU: by what compilers say of its registers and instructions, not timed.",
        local=True,
    ),
    "direct": Variant(
        None,
        False,
        {
            3: {FORWARD: 9e-7, INPUT: 1.3e-6, WEIGHTS: 3.5e-7},
            1: {FORWARD: 3.5e-7, INPUT: 4.5e-7, WEIGHTS: 4e-7},
        },
        ("CPU", "GPU"),
        {FORWARD: 0, INPUT: 0, WEIGHTS: 0},
        "CPU: images of less than 256 pixels and channels beside the multiples of 16, 2 cores with"
        " AVX-512.",
    ),
    "winograd2": Variant(
        2,
        False,
        {3: {FORWARD: 7e-7, INPUT: 8e-7, WEIGHTS: 4e-7}},
        ("CPU",),
        {FORWARD: 256, INPUT: 256},
        "CPU: images of 256 to 900 pixels, and the most exact of all, 2 cores with AVX-512.",
    ),
    "winograd4": Variant(
        4,
        False,
        {3: {FORWARD: 2.2e-6, INPUT: 2.6e-6, WEIGHTS: 8.5e-7}},
        ("CPU",),
        {FORWARD: 900, INPUT: 900, WEIGHTS: 64},
        "CPU: 2.7 times as fast as direct in the paper's network at 256x256, 2 cores with AVX-512.",
    ),
    "winograd4_half": Variant(
        4,
        True,
        {3: {FORWARD: 1.5e-3, INPUT: 1.5e-3}},
        ("CPU",),
        {},
        "CPU, where --tolerance allows it: forward 7 to 16 % faster than winograd4 at 512 channels,"
        " 2 cores with AVX-512.",
    ),
    "winograd2_gemm": Variant(
        2,
        False,
        {3: {FORWARD: 7e-7, INPUT: 8e-7}},
        ("GPU",),
        {},
        "GPU, where `pp-cl tune` finds it faster than local: not timed.",
        local=True,
    ),
    "winograd4_gemm": Variant(
        4,
        False,
        {3: {FORWARD: 2.2e-6, INPUT: 2.6e-6}},
        ("GPU",),
        {},
        "GPU, where `pp-cl tune` finds it faster than local: not timed.",
        local=True,
    ),
}


class Convolution(Protocol):
    """A variant on a device: what the classes of the modules variant_*.py do."""

    def work_floats(
        self, direction: Direction, height: int, weight_shape: tuple, c: int
    ) -> tuple[int, int]:
        """(floats of Work.scratch, floats of Work.weights) for an image `height` high.

        weight_shape: (ceil(CO/16), K, K, CI, 16); c: input channels, of a gradient of the input
        those of the one source.
        """

    def lay_out(self, weight: Array) -> Array | None:
        """The weights as forward() transforms them in each call, in an array of their own; None if
        it reads them as they are.
        """

    def forward(
        self,
        sources: tuple[Array, ...],
        weight: Array,
        bias: Array,
        out: Array,
        *,
        relu: bool,
        work: Work,
        tiles: Tiles | None = None,
        laid_out: Array | None = None,
    ) -> None:
        """As conv.conv_forward. laid_out: lay_out(weight), if it was called before."""

    def backward_input(
        self,
        weight: Array,
        first: int,
        grad_out: Array,
        grad_x: Array,
        *,
        mask: Array | None,
        work: Work,
        tiles: Tiles | None = None,
    ) -> None:
        """As conv.conv_backward_input, from the weights of forward(); first: the input channel of
        weight that is grad_x's first.
        """

    def backward_weights(
        self,
        sources: tuple[Array, ...],
        grad_out: Array,
        grad_weight: Array,
        grad_bias: Array,
        *,
        work: Work,
        tiles: Tiles | None = None,
    ) -> None:
        """As conv_backward_weights.conv_backward_weights."""


@dataclass(frozen=True)
class ConvShape:
    """One direction of a convolution, as far as the choice of a variant goes.

    k: side of the kernel. sources: channels of each input. co: output channels. pixels: of the
    image. source: index of the input whose gradient is computed, None in the other directions.
    """

    direction: Direction
    k: int
    sources: tuple[int, ...]
    co: int
    pixels: int
    source: int | None = None

    @property
    def ci(self) -> int:
        """Input channels; of a gradient of the input, those of its one source."""
        return sum(self.sources) if self.source is None else self.sources[self.source]


def offered(device_class: str) -> list[str]:
    """The names of the variants that are worth trying on a class of devices."""
    return [name for name, variant in VARIANTS.items() if device_class in variant.devices]


def shipped_order(device_class: str, shape: ConvShape) -> list[str]:
    """The variants that can run a convolution and have a kernel of their own for its direction, the
    shipped choice first.
    """
    names = [
        name
        for name in offered(device_class)
        if VARIANTS[name].can_run(shape.k, *shape.sources, shape.co)
        and shape.direction in VARIANTS[name].errors[shape.k]
    ]
    if device_class != "CPU":
        return names

    def least_pixels(name):
        least = VARIANTS[name].shipped_from.get(shape.direction)
        return -1 if least is None or least > shape.pixels else least

    return sorted(names, key=least_pixels, reverse=True)
