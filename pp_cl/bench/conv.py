"""`pp-cl bench conv`: time against error of the variants of every convolution of the network.

Errors are against float64 (reference/network.py): of outputs and input gradients at SAMPLES pixels,
of weights' gradients at SAMPLE_CHANNELS x SAMPLE_CHANNELS channels and every tap.
"""

from collections.abc import Callable, Iterator

import numpy as np

from pp_cl.bench.timing import PeakFlops, errors, variant_rows
from pp_cl.device.device import Device
from pp_cl.layers.choice import OFFERED, VARIANTS, ConvolutionPolicy, can_run, device_class
from pp_cl.layers.conv_direct import Direction, pack_bias, pack_weights, unpack_weights
from pp_cl.layers.tiles import all_tiles
from pp_cl.network.layers import convolutions, unet_layers
from pp_cl.reference import network as reference

SAMPLES = 256  # pixels: some of every place in the tiles of any variant
SAMPLE_CHANNELS = 16


class RandomConv:
    """A K x K convolution of one or two sources to `co` channels at side x side pixels, with ReLU
    where K is 3, on random data.

    The sources are a ReLU's outputs, weights and bias of PyTorch's initial size, the gradient given
    is normal. variants: names of those that are offered to the device and can run it.
    """

    def __init__(
        self, dev: Device, k: int, side: int, sources: tuple[int, ...], *, co: int, seed: int = 0
    ):
        rng = np.random.default_rng(seed)
        ci = sum(sources)
        bound = 1 / np.sqrt(ci * k * k)
        self.dev, self.k, self.relu = dev, k, k == 3
        self.plain_x = np.maximum(rng.normal(size=(side, side, ci)), 0).astype(np.float32)
        self.plain_weight = rng.uniform(-bound, bound, (co, ci, k, k)).astype(np.float32)
        self.plain_bias = rng.uniform(-bound, bound, co).astype(np.float32)
        self.plain_grad_out = rng.normal(size=(side, side, co)).astype(np.float32)
        self.pixels = tuple(rng.integers(0, side, (2, SAMPLES)))
        self.channels = [np.sort(rng.permutation(n)[:SAMPLE_CHANNELS]) for n in (co, ci)]

        splits = np.split(self.plain_x, np.cumsum(sources)[:-1], axis=2)
        self.x = tuple(dev.upload(s) for s in splits)
        self.grad_x = [dev.empty(s.shape) for s in splits]
        self.weight = dev.upload(pack_weights(self.plain_weight))
        self.bias = dev.upload(pack_bias(self.plain_bias))
        self.grad_weight, self.grad_bias = dev.empty(self.weight.shape), dev.empty(self.bias.shape)
        self.out, self.grad_out = dev.empty((side, side, co)), dev.upload(self.plain_grad_out)
        self.tiles = all_tiles(dev, side, side)
        self.variants = [
            name for name in OFFERED[device_class(dev)] if can_run(name, k, *sources, co)
        ]

    def runner(self, variant: str, direction: Direction, policy: ConvolutionPolicy) -> Callable:
        """A function that computes a direction by a variant, as the network does, and waits for
        it. policy: its blocking is used.
        """
        conv, blocking = VARIANTS[variant], policy.blocking
        compute = {
            Direction.FORWARD: self._run_forward,
            Direction.BACKWARD_INPUT: self._run_backward_input,
            Direction.BACKWARD_WEIGHTS: self._run_backward_weights,
        }[direction]

        def run():
            compute(conv, blocking)
            self.dev.finish()

        return run

    def _run_forward(self, conv, blocking):
        conv.forward(
            self.dev,
            blocking,
            self.x,
            self.weight,
            self.bias,
            self.out,
            relu=self.relu,
            tiles=self.tiles,
        )

    def _run_backward_input(self, conv, blocking):
        first = 0
        for x, grad_x in zip(self.x, self.grad_x, strict=True):
            conv.backward_input(
                self.dev,
                blocking,
                self.weight,
                first,
                self.grad_out,
                grad_x,
                mask=x,
                tiles=self.tiles,
            )
            first += x.shape[2]

    def _run_backward_weights(self, conv, blocking):
        conv.backward_weights(
            self.dev,
            blocking,
            self.x,
            self.grad_out,
            self.grad_weight,
            self.grad_bias,
            tiles=self.tiles,
        )

    def result(
        self, variant: str, direction: Direction, policy: ConvolutionPolicy
    ) -> tuple[np.ndarray, np.ndarray]:
        """(computed, float64) values of the sample."""
        self.runner(variant, direction, policy)()
        return {
            Direction.FORWARD: self._forward,
            Direction.BACKWARD_INPUT: self._backward_input,
            Direction.BACKWARD_WEIGHTS: self._backward_weights,
        }[direction]()

    def _forward(self):
        expected = reference.convolution_at(
            self.plain_x, self.plain_weight, self.plain_bias, self.pixels
        )
        return self.out.get()[self.pixels], np.maximum(expected, 0) if self.relu else expected

    def _backward_input(self):
        expected = reference.convolution_at(
            self.plain_grad_out, reference.flipped(self.plain_weight), 0.0, self.pixels
        )
        actual = np.concatenate([grad.get()[self.pixels] for grad in self.grad_x], 1)
        return actual, expected * (self.plain_x[self.pixels] > 0)

    def _backward_weights(self):
        co, ci = self.channels
        actual = unpack_weights(self.grad_weight.get(), self.out.shape[2])[np.ix_(co, ci)]
        return actual, reference.convolution_backward_weights(
            self.plain_x[..., ci], self.plain_grad_out[..., co], self.k
        )


def bench_conv(
    dev: Device,
    size: int,
    widths: tuple[int, int, int],
    policy: ConvolutionPolicy,
    *,
    blocks: str = "double",
) -> Iterator[list[dict]]:
    """Rows of every distinct convolution of the network at size x size, a list for each direction.

    policy: its blocking is used; every variant is measured. blocks: as UNet takes them.
    """
    peak, seen = PeakFlops(dev), set()
    for layer in convolutions(unet_layers(widths, blocks=blocks)):
        side = size >> layer.level
        key = (layer.kernel_size, side, layer.sources, layer.channels)
        if key in seen:
            continue
        seen.add(key)
        conv = RandomConv(dev, layer.kernel_size, side, layer.sources, co=layer.channels)
        shape = [side, side, sum(layer.sources), layer.channels, layer.kernel_size]
        for direction in Direction:
            runs = {v: conv.runner(v, direction, policy) for v in conv.variants}
            found = {v: errors(*conv.result(v, direction, policy)) for v in conv.variants}
            yield variant_rows(
                {"layer": layer.name, "shape": shape, "direction": direction.value},
                runs,
                found,
                flops=2 * layer.multiplications(size, size),
                peak=peak,
            )
