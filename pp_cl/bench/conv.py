"""`pp-cl bench conv`: time against error of every convolution of the network, by variant."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pp_cl.bench.timing import errors, variant_rows
from pp_cl.engine.device.buffers import PackedArrays
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers import choice
from pp_cl.engine.layers.conv import (
    DIRECTIONS,
    Blocking,
    Conv,
    ConvShape,
    gradient_parts,
    pack_bias,
    pack_weights,
    sum_parts,
)
from pp_cl.engine.layers.tiles import Tiles, all_tiles
from pp_cl.engine.network.layers import convolutions, unet_layers
from pp_cl.reference import network as reference

CHECK_SIDE = 33  # whole and partial tiles for any variant; float64 takes a second
# the parts of Layer.expected for which errors are reported
RESULTS = {"forward": slice(0, 1), "weights": slice(1, 2), "input": slice(3, None)}


@dataclass
class Layer:
    """A convolution with its input: parts (H, W, C) float32, weight (CO, CI, K, K), bias (CO,),
    grad_out (H, W, CO). relu: whether the output has a ReLU, and the input had one, which masks its
    gradient.
    """

    parts: Sequence[np.ndarray]
    weight: np.ndarray
    bias: np.ndarray
    grad_out: np.ndarray
    relu: bool = False

    @classmethod
    def random(
        cls,
        rng: np.random.Generator,
        size: tuple[int, int],
        channels: tuple[int, ...],
        co: int,
        k: int = 3,
    ) -> "Layer":
        """A layer with a ReLU's outputs as input, weights of PyTorch's initial size, normal
        gradients.
        """
        bound = 1 / np.sqrt(sum(channels) * k * k)
        weight = rng.uniform(-bound, bound, (co, sum(channels), k, k)).astype(np.float32)
        bias = rng.uniform(-bound, bound, co).astype(np.float32)
        parts = [np.maximum(rng.normal(size=(*size, c)), 0).astype(np.float32) for c in channels]
        return cls(parts, weight, bias, rng.normal(size=(*size, co)).astype(np.float32), relu=True)

    @cached_property
    def expected(self) -> list[np.ndarray]:
        """Float64 [output, gradients of packed weights and bias, gradient of each part]."""
        x = np.concatenate(self.parts, 2)
        out = reference.convolution(x, self.weight, self.bias)
        grad_x = reference.convolution(self.grad_out, reference.flipped(self.weight))
        grad_x *= x > 0 if self.relu else 1
        k = self.weight.shape[2]
        grad_weight = reference.convolution_backward_weights(x, self.grad_out, k)
        firsts = np.cumsum([part.shape[2] for part in self.parts])[:-1]
        return [
            np.maximum(out, 0) if self.relu else out,
            pack_weights(grad_weight, np.float64),
            pack_bias(self.grad_out.sum((0, 1), dtype=np.float64), np.float64),
            *np.split(grad_x, firsts, 2),
        ]

    def computed(
        self, dev: Device, variant: str, blocking: Blocking, tiles: Tiles | None = None
    ) -> list[np.ndarray]:
        """The arrays of `expected`, computed by a variant. tiles: of output and gradients."""
        uploaded = UploadedLayer(dev, self)
        for direction in DIRECTIONS:
            uploaded.compute(variant, blocking, direction, tiles)
        results = uploaded.out, uploaded.grad_weight, uploaded.grad_bias, *uploaded.grad_parts
        return [array.get() for array in results]


class UploadedLayer:
    """A Layer's arrays on the device. variants: those offered to the device that can run them."""

    def __init__(self, dev: Device, layer: Layer):
        self.dev, self.relu = dev, layer.relu
        self.parts = tuple(dev.upload(part) for part in layer.parts)
        self.weight = dev.upload(pack_weights(layer.weight))
        self.bias, self.grad_out = dev.upload(pack_bias(layer.bias)), dev.upload(layer.grad_out)
        self.out = dev.empty(self.grad_out.shape)
        self.grad_parts = [dev.empty(part.shape) for part in layer.parts]
        self.grad_weight, self.grad_bias = dev.empty(self.weight.shape), dev.empty(self.bias.shape)
        co, k = layer.weight.shape[0], layer.weight.shape[2]
        sources = [part.shape[2] for part in layer.parts]
        self.table = PackedArrays(dev)
        self.variants = [
            v
            for v in choice.OFFERED[choice.device_class(dev)]
            if choice.can_run(v, k, *sources, co)
        ]

    def runner(self, variant: str, direction: str, blocking: Blocking) -> Callable:
        """A function that computes a direction with a variant and waits for the result."""
        tiles = all_tiles(self.dev, *self.grad_out.shape[:2])

        def run():
            self.compute(variant, blocking, direction, tiles)
            self.dev.finish()

        return run

    def compute(
        self, variant: str, blocking: Blocking, direction: str, tiles: Tiles | None
    ) -> None:
        """Compute a direction with a variant, as each step of a training does."""
        dev, kernels = self.dev, choice.VARIANTS[variant]
        parts, grad_out = self.parts, self.grad_out
        channels = tuple(part.shape[2] for part in parts)
        height, width, co = grad_out.shape
        tiles = tiles or all_tiles(dev, height, width)
        shape = ConvShape(direction, self.weight.shape[1], channels, co, (height, width))
        conv = Conv(dev, blocking, variant, shape, self.weight, self.bias)
        for name, (needed, _) in choice.work_table(variant, shape).items():
            n = math.prod(needed)
            conv.take(name, dev.scratch(f"bench: {name}", n)[:n].reshape(needed))
        choice.lay_out(dev, [conv], self.weight.reshape(-1), conv.work)
        if direction == "forward":
            kernels.forward(conv, parts, self.out, relu=self.relu, tiles=tiles)
            return
        masks = [self.relu] * len(parts)
        count = kernels.backward(
            conv, parts, grad_out, self.grad_parts, masks=masks, tiles=tiles, grad_tiles=tiles
        )
        grads = self.grad_weight, self.grad_bias
        sum_parts(dev, gradient_parts([(conv, count)], self.table, conv.partial), *grads)


def layer_errors(layer: Layer, computed: list[np.ndarray], result: str) -> tuple[float, float]:
    """errors() of one of RESULTS, which Layer.computed() returned."""
    own = RESULTS[result]
    actual, expected = (
        np.concatenate([array.ravel() for array in arrays[own]])
        for arrays in (computed, layer.expected)
    )
    return errors(actual, expected)


def _direction_errors(layer, computed, direction):
    """Each of layer_errors() at its largest over the results of a direction."""
    results = ["forward"] if direction == "forward" else ["weights", "input"]
    pairs = [layer_errors(layer, computed, result) for result in results]
    return tuple(max(each) for each in zip(*pairs, strict=True))


def bench_conv(
    dev: Device, size: int, widths: tuple[int, int, int], *, blocks: str = "double"
) -> Iterator[dict]:
    """Yield rows for the network's distinct convolutions at size x size, by direction, variant."""
    rng, blocking = np.random.default_rng(0), choice.blocking_of(dev)
    distinct: dict[tuple, Any] = {}
    for layer in convolutions(unet_layers(widths, blocks=blocks)):
        distinct.setdefault((layer.kernel_size, layer.level, layer.sources, layer.channels), layer)
    for layer in distinct.values():
        side, k = size >> layer.level, layer.kernel_size
        timed, checked = (
            Layer.random(rng, (n, n), layer.sources, layer.channels, k)
            for n in (side, min(side, CHECK_SIDE))
        )
        uploaded = UploadedLayer(dev, timed)
        computed = {v: checked.computed(dev, v, blocking) for v in uploaded.variants}
        shape = [side, side, sum(layer.sources), layer.channels, k]
        for direction in DIRECTIONS:
            yield from variant_rows(
                {"layer": layer.name, "shape": shape, "direction": direction},
                {v: uploaded.runner(v, direction, blocking) for v in uploaded.variants},
                {
                    v: _direction_errors(checked, results, direction)
                    for v, results in computed.items()
                },
                flops=(2 if direction == "forward" else 4) * layer.multiplications(size, size),
            )
