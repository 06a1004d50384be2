"""A convolution by one variant in all directions, against float64."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pp_cl.device.device import Device
from pp_cl.layers.choice import VARIANTS
from pp_cl.layers.conv import Blocking, Direction, Work, pack_bias, pack_weights, unpack_weights
from pp_cl.reference.network import convolution, convolution_backward_weights, flipped
from pp_cl.selftest.case import Check, allowed

# of the largest value: the transforms of F(4x4) add up 36 numbers of a few times its size, and a
# sum over 4608 products is off by the root of so many roundings
SHARE = 1e-5


class Result(NamedTuple):
    """of_channels: whether it is a feature map, (H, W, C)."""

    actual: np.ndarray
    expected: np.ndarray
    of_channels: bool = False


class Layer:
    """A convolution with its input, and all of its gradients, in float64.

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
        self.parts, self.weight, self.bias = list(parts), weight, bias
        self.grad_out, self.relu, self.k = grad_out, relu, weight.shape[2]
        self.x = np.concatenate(self.parts, 2)
        out = convolution(self.x, weight, bias)
        self.out = np.maximum(out, 0) if relu else out
        self.grad_x = convolution(grad_out, flipped(weight)) * (self.x > 0 if relu else 1)
        self.grad_weight = convolution_backward_weights(self.x, grad_out, self.k)
        self.grad_bias = grad_out.sum((0, 1), dtype=np.float64)

    def results(self, dev: Device, variant: str, blocking: Blocking) -> Iterator[Result]:
        """Of the forward pass, of the weights, of the bias and of each part of the input."""
        run = _Run(self, dev, variant, blocking)
        yield Result(run.forward(), self.out, True)
        grad_weight, grad_bias = run.backward_weights()
        yield Result(grad_weight, self.grad_weight)
        yield Result(grad_bias, self.grad_bias)
        first = 0
        for i, part in enumerate(self.parts):
            channels = slice(first, first + part.shape[2])
            yield Result(run.backward_input(i, first), self.grad_x[..., channels], True)
            first = channels.stop


class _Run:
    """A layer on the device, by one variant."""

    def __init__(self, layer, dev, variant, blocking):
        self.layer, self.dev = layer, dev
        self.conv, self.blocking = VARIANTS[variant].module, blocking
        self.sources = tuple(dev.upload(part) for part in layer.parts)
        self.weight = dev.upload(pack_weights(layer.weight))
        self.grad_out = dev.upload(layer.grad_out)

    def forward(self):
        out = self.dev.empty(self.layer.out.shape)
        self.conv.forward(
            self.dev,
            self.blocking,
            self.sources,
            self.weight,
            self.dev.upload(pack_bias(self.layer.bias)),
            out,
            relu=self.layer.relu,
            work=self._work(Direction.FORWARD, self.layer.x.shape[2]),
        )
        return out.get()

    def backward_weights(self):
        co = len(self.layer.weight)
        grad_weight, grad_bias = (
            self.dev.empty(self.weight.shape),
            self.dev.empty(-(-co // 16) * 16),
        )
        self.conv.backward_weights(
            self.dev,
            self.blocking,
            self.sources,
            self.grad_out,
            grad_weight,
            grad_bias,
            work=self._work(Direction.BACKWARD_WEIGHTS, self.layer.x.shape[2]),
        )
        return unpack_weights(grad_weight.get(), co), grad_bias.get()[:co]

    def backward_input(self, i, first):
        source = self.sources[i]
        grad_x = self.dev.empty(source.shape)
        self.conv.backward_input(
            self.dev,
            self.blocking,
            self.weight,
            first,
            self.grad_out,
            grad_x,
            mask=source if self.layer.relu else None,
            work=self._work(Direction.BACKWARD_INPUT, source.shape[2]),
        )
        return grad_x.get()

    def _work(self, direction, c):
        height = len(self.layer.x)
        floats = self.conv.work_floats(
            self.dev, self.blocking, direction, height, self.weight.shape, c
        )
        return Work.empty(self.dev, *floats)


def within(result: Result) -> Check:
    """Each value against SHARE of the largest: of its channel, if it is a convolution's."""
    expected = result.expected
    most = SHARE * np.abs(expected).max((0, 1) if result.of_channels else None)
    return allowed(result.actual, expected, np.broadcast_to(most, expected.shape))
