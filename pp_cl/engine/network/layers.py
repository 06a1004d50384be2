"""The architecture of the U-Net as a list of layers: three levels, like the decoder in the
PlenopticPoints supplemental. Also decides which of its feature maps share memory.

Each level is a block: two 3x3 convolutions with ReLU, or one of the alternatives that the
supplemental compares with them. On the way down, 2x2 average pooling joins the levels; on the way
up, bilinear upsampling with a 1x1 convolution and a concatenation [upsampled, skip]; the image is
0.5 + 0.5 * (1x1 convolution). The 1x1 convolution runs before the upsampling: both are linear and
the upsampling weights of a pixel add up to 1, so they commute, bias included, and it costs a
quarter.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pp_cl.engine.device.buffers import Table
from pp_cl.engine.layers.conv import packed_shape
from pp_cl.engine.layers.tiles import VECTOR


@dataclass(frozen=True)
class Layer:
    """A layer, named like its output.

    kind: "conv": a convolution; "gate": ELU of one half of the input's channels times the sigmoid
    of the other half; "pool": means of 2 x 2 pixels; "upsample": doubles height and width,
    bilinear. inputs: the name of one layer, or of two that a convolution concatenates; "x" is the
    network's input. level: the output has the image's height and width divided by 2**level.
    channels: those of the output. Only for convolutions: sources, the channels of each input;
    kernel_size, the side of the kernel; relu, whether a ReLU follows.
    """

    kind: Literal["conv", "gate", "pool", "upsample"]
    name: str
    inputs: tuple[str, ...]
    level: int
    channels: int
    sources: tuple[int, ...] = ()
    kernel_size: int = 0
    relu: bool = False

    @property
    def reads_input_backward(self) -> bool:
        """Whether the backward pass reads the inputs."""
        return self.kind != "upsample"

    def weight_shape(self) -> tuple[int, int, int, int]:
        """(CO, CI, K, K), the shape of a convolution's weights."""
        return self.channels, sum(self.sources), self.kernel_size, self.kernel_size

    def multiplications(self, height: int, width: int) -> int:
        """Multiplications of weights by values in a forward pass over an image of this size,
        counted as direct convolutions.
        """
        weights = self.kernel_size**2 * sum(self.sources) * self.channels
        return weights * (height >> self.level) * (width >> self.level)


def _conv(name, inputs, level, channels, sources, kernel_size=3, relu=True):
    return Layer("conv", name, inputs, level, channels, sources, kernel_size, relu)


def _block(blocks, name, inputs, level, channels, sources):
    """The layers of one level."""
    if blocks == "gated":  # features and gates are one convolution: both read the same inputs
        both = _conv(f"{name}.a", inputs, level, 2 * channels, sources, relu=False)
        return [both, Layer("gate", f"{name}.gate", (both.name,), level, channels)]
    first = _conv(f"{name}.a", inputs, level, channels, sources)
    if blocks == "single":
        return [first]
    return [first, _conv(f"{name}.b", (first.name,), level, channels, (channels,))]


def unet_layers(
    widths: tuple[int, int, int],
    channels_in: int = 16,
    channels_out: int = 3,
    blocks: str = "double",
) -> list[Layer]:
    """The layers in the order of the forward pass. widths: channels of the three levels; blocks:
    what each level computes, one of settings.BLOCKS.
    """
    w0, w1, w2 = widths
    enc0 = _block(blocks, "enc0", ("x",), 0, w0, (channels_in,))
    enc1 = _block(blocks, "enc1", ("pool0",), 1, w1, (w0,))
    enc2 = _block(blocks, "enc2", ("pool1",), 2, w2, (w1,))
    skip0, skip1 = enc0[-1].name, enc1[-1].name
    dec1 = _block(blocks, "dec1", ("wide1", skip1), 1, w1, (w1, w1))
    dec0 = _block(blocks, "dec0", ("wide0", skip0), 0, w0, (w0, w0))
    return [
        *enc0,
        Layer("pool", "pool0", (skip0,), 1, w0),
        *enc1,
        Layer("pool", "pool1", (skip1,), 2, w1),
        *enc2,
        _conv("up1", (enc2[-1].name,), 2, w1, (w2,), kernel_size=1, relu=False),
        Layer("upsample", "wide1", ("up1",), 1, w1),
        *dec1,
        _conv("up0", (dec1[-1].name,), 1, w0, (w1,), kernel_size=1, relu=False),
        Layer("upsample", "wide0", ("up0",), 0, w0),
        *dec0,
        _conv("out", (dec0[-1].name,), 0, channels_out, (w0,), kernel_size=1, relu=False),
    ]


def convolutions(layers: list[Layer]) -> list[Layer]:
    """The layers that have parameters."""
    return [layer for layer in layers if layer.kind == "conv"]


def parameter_table(layers: list[Layer]) -> Table:
    """{name: (shape, dtype)} of the parameters: "enc0.a.weight" (ceil(CO/16), K, K, CI, 16),
    "enc0.a.bias" (ceil(CO/16) * 16,), ...
    """
    table: Table = {}
    for layer in convolutions(layers):
        co, ci, k, _ = layer.weight_shape()
        shape = packed_shape(k, ci, co)
        table[layer.name + ".weight"] = shape, np.float32
        table[layer.name + ".bias"] = (shape[0] * VECTOR,), np.float32
    return table


def gradient_of(name: str) -> str:
    """The name of the array that holds the gradient of a layer's output, or of a parameter."""
    return f"grad {name}"


def levels_of(layers: list[Layer]) -> dict[str, int]:
    """{name: level} of the network's input "x", of all layers' outputs, and of their gradients."""
    levels = {"x": 0} | {layer.name: layer.level for layer in layers}
    return levels | {gradient_of(name): level for name, level in levels.items()}


def array_shapes(layers: list[Layer], size: tuple[int, int]) -> dict[str, tuple[int, int, int]]:
    """{name: (H, W, C)} of the input x, all outputs and their gradients, for an image of `size` =
    (height, width).
    """
    channels = {"x": sum(layers[0].sources)} | {layer.name: layer.channels for layer in layers}
    channels |= {gradient_of(name): n for name, n in channels.items()}
    return {
        name: (size[0] >> level, size[1] >> level, channels[name])
        for name, level in levels_of(layers).items()
    }


def multiplications(layers: list[Layer], height: int, width: int) -> int:
    """Multiplications of weights by values in a forward pass over an image of this size."""
    return sum(layer.multiplications(height, width) for layer in layers)


# ---- arrays that share memory


def lifetimes(layers: list[Layer], training: bool) -> list[tuple[str, int, int]]:
    """[(name, first, last)] by first use: the first and last layer that uses each array, counted
    through the forward and the backward pass.

    Leaves out the network's input "x" and the gradient of its output, which belong to the caller.
    """
    schedule = [(*layer.inputs, layer.name) for layer in layers]
    if training:
        for layer in reversed(layers):
            read = layer.inputs if layer.reads_input_backward else ()
            written = [gradient_of(name) for name in layer.inputs]
            schedule.append((*read, gradient_of(layer.name), *written))
    spans: dict[str, Any] = {}
    for time, names in enumerate(schedule):
        for name in names:
            spans[name] = (spans.get(name, (time,))[0], time)
    del spans["x"]
    last = layers[-1].name
    spans.pop(gradient_of(last), None)
    spans[last] = (spans[last][0], len(schedule))  # the caller may read it after backward
    return [(name, *lifetime) for name, lifetime in spans.items()]


@dataclass
class SharedBuffer:
    """A buffer of `floats` floats that holds several arrays in turn; free from the step `free_from`
    on.
    """

    floats: int
    names: list[str]
    free_from: int


def share_buffers(
    lifetimes: list[tuple[str, int, int]], shapes: dict[str, tuple]
) -> list[SharedBuffer]:
    """Buffers in which no two arrays live at the same time.

    lifetimes: [(name, first, last)] by first use. An array takes the free buffer that fits it best;
    if none is large enough, the largest free one grows.
    """
    buffers: list[SharedBuffer] = []
    for name, first, last in lifetimes:
        floats = math.prod(shapes[name])
        free = [b for b in buffers if b.free_from <= first]
        large = [b for b in free if b.floats >= floats]
        if large:
            buffer = min(large, key=lambda b: b.floats)
        elif free:
            buffer = max(free, key=lambda b: b.floats)
        else:
            buffer = SharedBuffer(0, [], 0)
            buffers.append(buffer)
        buffer.floats = max(buffer.floats, floats)
        buffer.names.append(name)
        buffer.free_from = last + 1
    return buffers
