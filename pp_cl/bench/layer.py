"""One convolution on random data for `pp-cl bench conv`: what the network does for it, and float64
values of a sample.
"""

import numpy as np

from pp_cl.layers import variants
from pp_cl.layers.conv import pack_bias, pack_weights, unpack_weights
from pp_cl.reference import network as reference

DIRECTIONS = ("forward", "input", "weights")
SAMPLES = 256  # pixels: some of every place in the tiles of any variant
SAMPLE_CHANNELS = 16


class Layer:
    """A K x K convolution of one or two sources to `co` channels at side x side pixels, with ReLU
    where K is 3.

    The sources are a ReLU's outputs, weights and bias of PyTorch's initial size, the gradient given
    is normal. variants: names of those that can take it.
    """

    def __init__(self, dev, k, side, sources, co, seed=0):
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
        self.x, self.grad_x = [dev.upload(s) for s in splits], [dev.empty(s.shape) for s in splits]
        self.weight, self.bias = (
            dev.upload(pack_weights(self.plain_weight)),
            dev.upload(pack_bias(self.plain_bias)),
        )
        self.grad_weight, self.grad_bias = dev.empty(self.weight.shape), dev.empty(self.bias.shape)
        self.out, self.grad_out = dev.empty((side, side, co)), dev.upload(self.plain_grad_out)
        self.variants = [
            v for v in variants.offered(dev) if variants.applicable(v, k, *sources, co) == v
        ]
        self.work = self.make_work()

    def make_work(self):
        """Memory for all variants and directions to work in, with the device's present tile
        shapes.
        """
        floats = [
            variants.work_floats(
                self.dev,
                variant,
                direction,
                self.out.shape[0],
                self.weight.shape,
                x.shape[2] if direction == "input" else None,
            )
            for variant in self.variants
            for direction in DIRECTIONS
            for x in self.x
        ]
        return variants.Work(*[self.dev.empty(max(1, *n)) for n in zip(*floats, strict=True)])

    def runner(self, variant, direction):
        """A function that computes a direction in a variant, as the network does, and waits for
        it.
        """

        def run():
            if direction == "forward":
                variants.forward(
                    self.dev,
                    variant,
                    self.x[0],
                    self.weight,
                    self.bias,
                    self.out,
                    self.relu,
                    self.work,
                    *self.x[1:],
                )
            elif direction == "weights":
                variants.backward_weights(
                    self.dev,
                    variant,
                    self.x[0],
                    self.grad_out,
                    self.grad_weight,
                    self.grad_bias,
                    self.work,
                    *self.x[1:],
                )
            else:
                first = 0
                for x, grad_x in zip(self.x, self.grad_x, strict=True):
                    variants.backward_input(
                        self.dev,
                        variant,
                        x,
                        self.weight,
                        first,
                        self.grad_out,
                        grad_x,
                        True,
                        self.work,
                    )
                    first += x.shape[2]
            self.dev.finish()

        return run

    def result(self, variant, direction):
        """(computed, float64) values of the sample."""
        self.runner(variant, direction)()
        return getattr(self, "_" + direction)()

    def _forward(self):
        expected = reference.convolution_at(
            self.plain_x, self.plain_weight, self.plain_bias, self.pixels
        )
        return self.out.get()[self.pixels], np.maximum(expected, 0) if self.relu else expected

    def _input(self):
        expected = reference.convolution_at(
            self.plain_grad_out, reference.flipped(self.plain_weight), 0.0, self.pixels
        )
        actual = np.concatenate([grad.get()[self.pixels] for grad in self.grad_x], 1)
        return actual, expected * (self.plain_x[self.pixels] > 0)

    def _weights(self):
        co, ci = self.channels
        actual = unpack_weights(self.grad_weight.get(), self.out.shape[2])[np.ix_(co, ci)]
        return actual, reference.weight_gradient(
            self.plain_x[..., ci], self.plain_grad_out[..., co], self.k
        )
