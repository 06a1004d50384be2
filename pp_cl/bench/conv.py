"""`pp-cl bench conv`: time against error of the variants of every convolution of the network.

Errors are against float64 (reference/network.py): of outputs and input gradients at SAMPLES pixels,
of weights' gradients at SAMPLE_CHANNELS x SAMPLE_CHANNELS channels and every tap.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from pp_cl.bench.timing import PeakFlops, errors, variant_rows
from pp_cl.device.device import Device
from pp_cl.layers.choice import OFFERED, VARIANTS, blocking_of, can_run, device_class
from pp_cl.layers.conv_direct import (
    Blocking,
    ConvShape,
    DirectConv,
    Direction,
    pack_bias,
    pack_weights,
    sum_parts,
    table_of_sums,
    unpack_weights,
)
from pp_cl.layers.tiles import Tiles, all_tiles
from pp_cl.network.layers import convolutions, unet_layers
from pp_cl.reference import network as reference

SAMPLES = 256  # pixels: some of every place in the tiles of any variant
SAMPLE_CHANNELS = 16


class Layer:
    """A convolution with its input.

    parts: (H, W, C) float32, what is concatenated to the input. weight: (CO, CI, K, K). bias:
    (CO,). grad_out: (H, W, CO). relu: whether the output passes through one; the gradient of the
    input is masked by the input's own.
    """

    def __init__(
        self,
        parts: Sequence[np.ndarray],
        weight: np.ndarray,
        bias: np.ndarray,
        grad_out: np.ndarray,
        *,
        relu: bool = False,
    ):
        self.parts, self.weight, self.bias = tuple(parts), weight, bias
        self.grad_out, self.relu = grad_out, relu
        self.x = np.concatenate(self.parts, 2)

    @classmethod
    def random(
        cls,
        rng: np.random.Generator,
        size: tuple[int, int],
        channels: tuple[int, ...],
        co: int,
        k: int = 3,
    ) -> "Layer":
        """Of a ReLU's outputs of so many `channels`, with weights of PyTorch's initial size and
        normal gradients.
        """
        bound = 1 / np.sqrt(sum(channels) * k * k)
        weight = rng.uniform(-bound, bound, (co, sum(channels), k, k)).astype(np.float32)
        bias = rng.uniform(-bound, bound, co).astype(np.float32)
        parts = [np.maximum(rng.normal(size=(*size, c)), 0).astype(np.float32) for c in channels]
        return cls(parts, weight, bias, rng.normal(size=(*size, co)).astype(np.float32), relu=True)

    @cached_property
    def expected(self) -> list[np.ndarray]:
        """Float64 [output, gradients of the weights and the bias as the device lays them out,
        gradient of each part].
        """
        out = reference.convolution(self.x, self.weight, self.bias)
        grad_x = reference.convolution(self.grad_out, reference.flipped(self.weight))
        grad_x *= self.x > 0 if self.relu else 1
        k = self.weight.shape[2]
        grad_weight = reference.convolution_backward_weights(self.x, self.grad_out, k)
        firsts = np.cumsum([part.shape[2] for part in self.parts])[:-1]
        return [
            np.maximum(out, 0) if self.relu else out,
            pack_weights(grad_weight, np.float64),
            pack_bias(self.grad_out.sum((0, 1), dtype=np.float64), np.float64),
            *np.split(grad_x, firsts, 2),
        ]

    def computed(
        self,
        dev: Device,
        variant: type[DirectConv],
        blocking: Blocking,
        tiles: Tiles | None = None,
    ) -> list[np.ndarray]:
        """What `expected` lists, by a variant. tiles: of output and gradients."""
        uploaded = UploadedLayer(dev, self)
        for direction in Direction:
            uploaded.compute(variant, blocking, direction, tiles)
        results = uploaded.out, uploaded.grad_weight, uploaded.grad_bias, *uploaded.grad_parts
        return [array.get() for array in results]


class UploadedLayer:
    """The arrays of a Layer on the device, and those that its convolution fills."""

    def __init__(self, dev: Device, layer: Layer):
        self.dev, self.relu = dev, layer.relu
        self.parts = tuple(dev.upload(part) for part in layer.parts)
        self.weight = dev.upload(pack_weights(layer.weight))
        self.bias, self.grad_out = dev.upload(pack_bias(layer.bias)), dev.upload(layer.grad_out)
        self.out = dev.empty(self.grad_out.shape)
        self.grad_parts = [dev.empty(part.shape) for part in layer.parts]
        self.grad_weight, self.grad_bias = dev.empty(self.weight.shape), dev.empty(self.bias.shape)

    def compute(
        self,
        variant: type[DirectConv],
        blocking: Blocking,
        direction: Direction,
        tiles: Tiles | None,
    ) -> None:
        """Compute a direction by a variant, as the network does."""
        dev, parts, grad_out = self.dev, self.parts, self.grad_out
        channels = tuple(part.shape[2] for part in parts)
        height, width, co = grad_out.shape
        shape = ConvShape(direction, self.weight.shape[1], channels, co, (height, width))
        tiles = tiles or all_tiles(dev, height, width)
        if direction == Direction.FORWARD:
            conv = variant(dev, blocking, shape)
            weights = self._laid_out(conv)
            conv.forward(parts, weights, self.bias, self.out, relu=self.relu, tiles=tiles)
        elif direction == Direction.BACKWARD_WEIGHTS:
            conv = variant(dev, blocking, shape)
            partial = self._work(conv.work_shape)
            count = conv.backward_weights(parts, grad_out, partial, tiles=tiles)
            rows, n = table_of_sums([(partial.shape, count, 0, 0, 0)])
            table = dev.constant(rows)
            sum_parts(dev, table, n, partial, self.grad_weight, self.grad_bias)
        else:
            for i, (part, grad) in enumerate(zip(parts, self.grad_parts, strict=True)):
                conv = variant(dev, blocking, replace(shape, source=i))
                mask = part if self.relu else None
                conv.backward_input(self._laid_out(conv), grad_out, grad, mask=mask, tiles=tiles)

    def _laid_out(self, conv):
        """The weights as a convolution reads them, laid out anew as in each step of a training."""
        if conv.work_shape is None:
            return self.weight
        work = self._work(conv.work_shape)
        conv.lay_out(self.dev, self.weight.reshape(-1), [(conv.shape, 0, 0)], work)
        return work

    def _work(self, shape):
        n = math.prod(shape)
        return self.dev.scratch("bench: weights and parts of their gradients", n)[:n].reshape(shape)


class RandomConv:
    """A K x K convolution of one or two sources to `co` channels at side x side pixels, with ReLU,
    on random data. variants: names of those that are offered to the device and can run it.
    """

    def __init__(self, dev: Device, k: int, side: int, sources: tuple[int, ...], co: int):
        rng = np.random.default_rng(0)
        self.layer = Layer.random(rng, (side, side), sources, co, k)
        self.uploaded = UploadedLayer(dev, self.layer)
        self.tiles = all_tiles(dev, side, side)
        self.pixels = tuple(rng.integers(0, side, (2, SAMPLES)))
        self.channels = [np.sort(rng.permutation(n)[:SAMPLE_CHANNELS]) for n in (co, sum(sources))]
        self.variants = [
            name for name in OFFERED[device_class(dev)] if can_run(name, k, *sources, co)
        ]

    def runner(self, variant: str, direction: Direction, blocking: Blocking) -> Callable:
        """A function that computes a direction by a variant, as the network does, and waits for
        it.
        """

        def run():
            self.uploaded.compute(VARIANTS[variant], blocking, direction, self.tiles)
            self.uploaded.dev.finish()

        return run

    def result(
        self, variant: str, direction: Direction, blocking: Blocking
    ) -> tuple[np.ndarray, np.ndarray]:
        """(computed, float64) values of the sample."""
        self.runner(variant, direction, blocking)()
        layer, uploaded, at = self.layer, self.uploaded, self.pixels
        if direction == Direction.FORWARD:
            expected = reference.convolution_at(layer.x, layer.weight, layer.bias, at)
            return uploaded.out.get()[at], np.maximum(expected, 0)
        if direction == Direction.BACKWARD_INPUT:
            flipped = reference.flipped(layer.weight)
            expected = reference.convolution_at(layer.grad_out, flipped, 0.0, at)
            actual = np.concatenate([grad.get()[at] for grad in uploaded.grad_parts], 1)
            return actual, expected * (layer.x[at] > 0)
        co, ci = self.channels
        actual = unpack_weights(uploaded.grad_weight.get(), len(layer.weight))[np.ix_(co, ci)]
        return actual, reference.convolution_backward_weights(
            layer.x[..., ci], layer.grad_out[..., co], layer.weight.shape[2]
        )


def bench_conv(
    dev: Device,
    size: int,
    widths: tuple[int, int, int],
    *,
    blocks: str = "double",
) -> Iterator[dict]:
    """Rows of every distinct convolution of the network at size x size, by direction and variant.

    blocks: as UNet takes them.
    """
    peak, seen, blocking = PeakFlops(dev), set(), blocking_of(dev)
    for layer in convolutions(unet_layers(widths, blocks=blocks)):
        side = size >> layer.level
        key = (layer.kernel_size, side, layer.sources, layer.channels)
        if key in seen:
            continue
        seen.add(key)
        conv = RandomConv(dev, layer.kernel_size, side, layer.sources, co=layer.channels)
        shape = [side, side, sum(layer.sources), layer.channels, layer.kernel_size]
        for direction in Direction:
            runs = {v: conv.runner(v, direction, blocking) for v in conv.variants}
            found = {v: errors(*conv.result(v, direction, blocking)) for v in conv.variants}
            yield from variant_rows(
                {"layer": layer.name, "shape": shape, "direction": direction.value},
                runs,
                found,
                flops=2 * layer.multiplications(size, size),
                peak=peak,
            )
