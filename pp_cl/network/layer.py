"""The layers of a network: what each computes, in which tiles, from what, and at what cost.

A layer is named like its output. Feature maps are (H, W, C) float32; those at level L have the
image's height and width divided by 2**L. Distances are pixels of the image at every level.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.direction import Direction
from pp_cl.layers.gate import gate_backward, gate_forward
from pp_cl.layers.resample import (
    avgpool2_backward,
    avgpool2_forward,
    upsample2_backward,
    upsample2_forward,
)
from pp_cl.layers.tiles import Tiles
from pp_cl.layers.variants import Convolution, ConvShape
from pp_cl.layers.work import Work
from pp_cl.network.tile_sets import double, grow, halve
from pp_cl.reference import network as reference


class Resources(Protocol):
    """What layers compute with beside their inputs: a network at one image size.

    parameters, gradients: {"enc0.a.weight": ...} on the device.
    """

    dev: Device
    parameters: dict[str, Array]
    gradients: dict[str, Array]
    work: Work

    @abstractmethod
    def convolution(
        self, layer: "Conv", direction: Direction, source: int | None = None
    ) -> Convolution:
        """The variant that was chosen for a convolution."""

    def laid_out(self, layer: "Conv") -> Array | None:
        """The weights as the forward variant transforms them; None = not made in advance."""


@dataclass(frozen=True)
class Layer(ABC):
    """A layer whose output is `name`.

    inputs: names of one layer, or of the two that a convolution reads as one; "x" is the network's
    input. level, channels: of the output.
    """

    name: str
    inputs: tuple[str, ...]
    level: int
    channels: int

    reads_input_backward = True  # whether the backward pass reads the inputs
    relu = False  # whether the output is a ReLU's

    @abstractmethod
    def forward(
        self, resources: Resources, sources: tuple[Array, ...], out: Array, tiles: Tiles
    ) -> None:
        """Compute the tiles of out from the inputs."""

    @abstractmethod
    def backward_input(
        self,
        resources: Resources,
        source: int,
        grad_out: Array,
        grad_x: Array,
        *,
        x: Array,
        is_relu: bool,
        tiles: Tiles,
    ) -> None:
        """Compute the tiles of grad_x, the gradient of x, the input of number `source`.

        is_relu: x is a ReLU's output, and grad_x is to be the gradient of the ReLU's input.
        """

    def backward_weights(
        self, resources: Resources, sources: tuple[Array, ...], grad_out: Array, tiles: Tiles
    ) -> None:
        """Overwrite the gradients of the layer's parameters, if it has any."""
        return

    def multiplications(self, height: int, width: int) -> int:
        """Multiplications of weights by values in a forward pass over an image of this size."""
        return 0

    @abstractmethod
    def forward_radius(self) -> int:
        """How far from its place a change of the input changes the output, in pixels."""

    @abstractmethod
    def backward_radius(self) -> int:
        """The same from the gradient of the output to the gradient of the input."""

    @abstractmethod
    def needed_forward(self, computed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """(rows, columns) = shape bool: tiles of an input that the computed tiles of the output
        read.
        """

    @abstractmethod
    def needed_backward(self, computed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """(rows, columns) = shape bool: tiles of the gradient of the output that the computed tiles
        of an input's gradient read.
        """

    @abstractmethod
    def reference_forward(self, source: np.ndarray, parameters: dict) -> np.ndarray:
        """Float64 output from the inputs' concatenation (H, W, CI); parameters: {name: numpy}."""

    @abstractmethod
    def reference_backward(
        self, source: np.ndarray, grad_out: np.ndarray, parameters: dict
    ) -> tuple[np.ndarray, dict]:
        """(float64 gradient of the inputs' concatenation, {parameter: its gradient}), given that of
        the output before its ReLU.
        """


@dataclass(frozen=True)
class Conv(Layer):
    """Convolution K x K (K = 1 or 3), with ReLU or without.

    sources: channels of each input.
    """

    sources: tuple[int, ...]
    kernel_size: int = 3
    relu: bool = True

    def weight_shape(self) -> tuple[int, int, int, int]:
        """(CO, CI, K, K) of its weights."""
        return self.channels, sum(self.sources), self.kernel_size, self.kernel_size

    def conv_shape(self, direction: Direction, pixels: int, source: int | None = None) -> ConvShape:
        """What its variant is chosen by, for an input image of `pixels` pixels at its own level."""
        return ConvShape(direction, self.kernel_size, self.sources, self.channels, pixels, source)

    def computations(self, training: bool) -> list[tuple[Direction, int | None]]:
        """(direction, input or None) of all convolutions that a pass runs."""
        found = [(Direction.FORWARD, None)]
        if training:
            found.append((Direction.BACKWARD_WEIGHTS, None))
            found += [(Direction.BACKWARD_INPUT, i) for i in range(len(self.sources))]
        return found

    def forward(
        self, resources: Resources, sources: tuple[Array, ...], out: Array, tiles: Tiles
    ) -> None:
        """As Layer.forward."""
        resources.convolution(self, Direction.FORWARD).forward(
            sources,
            resources.parameters[self.name + ".weight"],
            resources.parameters[self.name + ".bias"],
            out,
            relu=self.relu,
            work=resources.work,
            tiles=tiles,
            laid_out=resources.laid_out(self),
        )

    def backward_input(
        self,
        resources: Resources,
        source: int,
        grad_out: Array,
        grad_x: Array,
        *,
        x: Array,
        is_relu: bool,
        tiles: Tiles,
    ) -> None:
        """As Layer.backward_input."""
        resources.convolution(self, Direction.BACKWARD_INPUT, source).backward_input(
            resources.parameters[self.name + ".weight"],
            sum(self.sources[:source]),
            grad_out,
            grad_x,
            mask=x if is_relu else None,
            work=resources.work,
            tiles=tiles,
        )

    def backward_weights(
        self, resources: Resources, sources: tuple[Array, ...], grad_out: Array, tiles: Tiles
    ) -> None:
        """As Layer.backward_weights."""
        resources.convolution(self, Direction.BACKWARD_WEIGHTS).backward_weights(
            sources,
            grad_out,
            resources.gradients[self.name + ".weight"],
            resources.gradients[self.name + ".bias"],
            work=resources.work,
            tiles=tiles,
        )

    def multiplications(self, height: int, width: int) -> int:
        """As Layer.multiplications, counted as a direct convolution."""
        weights = self.kernel_size**2 * sum(self.sources) * self.channels
        return weights * (height >> self.level) * (width >> self.level)

    def forward_radius(self) -> int:
        """As Layer.forward_radius."""
        return self.kernel_size // 2 << self.level

    backward_radius = forward_radius

    def needed_forward(self, computed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """As Layer.needed_forward."""
        return grow(computed) if self.kernel_size > 1 else computed

    needed_backward = needed_forward

    def reference_forward(self, source: np.ndarray, parameters: dict) -> np.ndarray:
        """As Layer.reference_forward."""
        weight, bias = parameters[self.name + ".weight"], parameters[self.name + ".bias"]
        out = reference.convolution(source, weight, bias)
        return np.maximum(out, 0) if self.relu else out

    def reference_backward(
        self, source: np.ndarray, grad_out: np.ndarray, parameters: dict
    ) -> tuple[np.ndarray, dict]:
        """As Layer.reference_backward."""
        weight = parameters[self.name + ".weight"]
        gradients = {
            self.name + ".weight": reference.convolution_backward_weights(
                source, grad_out, self.kernel_size
            ),
            self.name + ".bias": grad_out.sum((0, 1)),
        }
        return reference.convolution(grad_out, reference.flipped(weight)), gradients


@dataclass(frozen=True)
class Gate(Layer):
    """ELU of one half of the input's channels times the sigmoid of the other half."""

    def forward(
        self, resources: Resources, sources: tuple[Array, ...], out: Array, tiles: Tiles
    ) -> None:
        """As Layer.forward."""
        gate_forward(resources.dev, sources[0], out, tiles=tiles)

    def backward_input(
        self,
        resources: Resources,
        source: int,
        grad_out: Array,
        grad_x: Array,
        *,
        x: Array,
        is_relu: bool,
        tiles: Tiles,
    ) -> None:
        """As Layer.backward_input. Its input is never a ReLU's output."""
        gate_backward(resources.dev, x, grad_out, grad_x, tiles=tiles)

    def forward_radius(self) -> int:
        """As Layer.forward_radius."""
        return 0

    backward_radius = forward_radius

    def needed_forward(self, computed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """As Layer.needed_forward."""
        return computed

    needed_backward = needed_forward

    def reference_forward(self, source: np.ndarray, parameters: dict) -> np.ndarray:
        """As Layer.reference_forward."""
        return reference.gate(source)

    def reference_backward(
        self, source: np.ndarray, grad_out: np.ndarray, parameters: dict
    ) -> tuple[np.ndarray, dict]:
        """As Layer.reference_backward."""
        return reference.gate_backward(source, grad_out), {}


@dataclass(frozen=True)
class Pool(Layer):
    """Mean of 2 x 2 pixels of a feature map that another layer (the skip) reads, too."""

    def forward(
        self, resources: Resources, sources: tuple[Array, ...], out: Array, tiles: Tiles
    ) -> None:
        """As Layer.forward."""
        avgpool2_forward(resources.dev, sources[0], out, tiles=tiles)

    def backward_input(
        self,
        resources: Resources,
        source: int,
        grad_out: Array,
        grad_x: Array,
        *,
        x: Array,
        is_relu: bool,
        tiles: Tiles,
    ) -> None:
        """As Layer.backward_input, but added to grad_x, where the skip's gradient is."""
        avgpool2_backward(resources.dev, x if is_relu else None, grad_out, grad_x, tiles=tiles)

    def forward_radius(self) -> int:
        """As Layer.forward_radius."""
        return 1 << self.level >> 1

    def backward_radius(self) -> int:
        """As Layer.backward_radius."""
        return 0

    def needed_forward(self, computed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """As Layer.needed_forward."""
        return double(computed, shape)

    def needed_backward(self, computed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """As Layer.needed_backward."""
        return halve(computed)

    def reference_forward(self, source: np.ndarray, parameters: dict) -> np.ndarray:
        """As Layer.reference_forward."""
        return reference.pool(source)

    def reference_backward(
        self, source: np.ndarray, grad_out: np.ndarray, parameters: dict
    ) -> tuple[np.ndarray, dict]:
        """As Layer.reference_backward."""
        return reference.pool_backward(grad_out), {}


@dataclass(frozen=True)
class Upsample(Layer):
    """Twice the height and width, bilinear."""

    reads_input_backward = False

    def forward(
        self, resources: Resources, sources: tuple[Array, ...], out: Array, tiles: Tiles
    ) -> None:
        """As Layer.forward."""
        upsample2_forward(resources.dev, sources[0], out, tiles=tiles)

    def backward_input(
        self,
        resources: Resources,
        source: int,
        grad_out: Array,
        grad_x: Array,
        *,
        x: Array,
        is_relu: bool,
        tiles: Tiles,
    ) -> None:
        """As Layer.backward_input. Its input is never a ReLU's output."""
        upsample2_backward(resources.dev, grad_out, grad_x, tiles=tiles)

    def forward_radius(self) -> int:
        """As Layer.forward_radius."""
        return 2 << self.level >> 1

    def backward_radius(self) -> int:
        """As Layer.backward_radius."""
        return 2 << self.level

    def needed_forward(self, computed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """As Layer.needed_forward."""
        return halve(grow(computed))

    def needed_backward(self, computed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """As Layer.needed_backward."""
        return grow(double(computed, shape))

    def reference_forward(self, source: np.ndarray, parameters: dict) -> np.ndarray:
        """As Layer.reference_forward."""
        return reference.upsample(source)

    def reference_backward(
        self, source: np.ndarray, grad_out: np.ndarray, parameters: dict
    ) -> tuple[np.ndarray, dict]:
        """As Layer.reference_backward."""
        return reference.upsample_backward(grad_out), {}
