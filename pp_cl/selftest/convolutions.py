"""A convolution on the device in all directions, and in float64."""

from collections.abc import Sequence
from types import ModuleType

import numpy as np

from pp_cl.device.device import Device
from pp_cl.layers.conv_direct import Blocking, pack_bias, pack_weights
from pp_cl.layers.tiles import Tiles
from pp_cl.reference.network import convolution, convolution_backward_weights, flipped
from pp_cl.selftest.case import Check, allowed

# of the largest value: the transforms of F(4x4) add up 36 numbers of a few times its size, and a
# sum over 4608 products is off by the root of so many roundings
SHARE = 1e-5


class Layer:
    """A convolution with its input.

    parts: (H, W, C) float32, what is concatenated to the input. weight: (CO, CI, K, K). bias:
    (CO,). grad_out: (H, W, CO). relu: whether the output passes through one; the gradient of the
    input is masked by the input's own. expected: float64 [output, gradients of the weights and the
    bias as the device lays them out, gradient of each part].
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
        x = np.concatenate(self.parts, 2)
        out = convolution(x, weight, bias)
        grad_x = convolution(grad_out, flipped(weight)) * (x > 0 if relu else 1)
        grad_weight = convolution_backward_weights(x, grad_out, weight.shape[2])
        firsts = np.cumsum([part.shape[2] for part in parts])[:-1]
        self.expected: list[np.ndarray] = [
            np.maximum(out, 0) if relu else out,
            pack_weights(grad_weight, np.float64),
            pack_bias(grad_out.sum((0, 1), dtype=np.float64), np.float64),
            *np.split(grad_x, firsts, 2),
        ]

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
        parts = [np.maximum(_normal(rng, *size, c), 0) for c in channels]
        return cls(parts, weight, bias, _normal(rng, *size, co), relu=True)

    def computed(
        self, dev: Device, conv: ModuleType, blocking: Blocking, tiles: Tiles | None = None
    ) -> list[np.ndarray]:
        """As `expected`, by a module of convolutions. tiles: of output and gradients."""
        sources = tuple(dev.upload(part) for part in self.parts)
        weight, bias = dev.upload(pack_weights(self.weight)), dev.upload(pack_bias(self.bias))
        grad_out = dev.upload(self.grad_out)

        out, grad_weight, grad_bias = (dev.empty(a.shape) for a in self.expected[:3])
        conv.forward(dev, blocking, sources, weight, bias, out, relu=self.relu, tiles=tiles)
        conv.backward_weights(dev, blocking, sources, grad_out, grad_weight, grad_bias, tiles=tiles)
        first, results = 0, [out, grad_weight, grad_bias]
        for source in sources:
            results.append(dev.empty(source.shape))
            conv.backward_input(
                dev,
                blocking,
                weight,
                first,
                grad_out,
                results[-1],
                mask=source if self.relu else None,
                tiles=tiles,
            )
            first += source.shape[2]
        return [array.get() for array in results]


def within(actual: np.ndarray, expected: np.ndarray) -> Check:
    """Each value against SHARE of the largest: of its channel, in a feature map (H, W, C)."""
    most = SHARE * np.abs(expected).max((0, 1) if expected.ndim == 3 else None)
    return allowed(actual, expected, np.broadcast_to(most, expected.shape))


def hard_layers() -> dict[str, Layer]:
    """3x3 convolutions whose inputs or weights are made to hurt float32 or Winograd."""
    rng = np.random.default_rng(7)

    def layer(x, weight, bias=None, grad_out=None):
        weight = np.asarray(weight, np.float32)
        bias = _normal(rng, len(weight)) if bias is None else bias
        grad_out = _normal(rng, *x.shape[:2], len(weight)) if grad_out is None else grad_out
        return Layer([x.astype(np.float32)], weight, bias, grad_out.astype(np.float32))

    x, weight = _normal(rng, 13, 17, 32), _normal(rng, 32, 32, 3, 3) / np.sqrt(np.float32(288))
    decades = 10 ** rng.uniform(-3, 3, 32)
    bright = np.zeros_like(x)
    bright[6, 8] = 1e3 * x[6, 8]
    limits = np.where(np.arange(32) % 2, 6e4, 1e-7)
    none = np.zeros(32, np.float32)
    return {
        "means of 1e3": layer(1e3 + x, weight),
        "means of 1e3, weights that sum to zero": layer(
            1e3 + x, weight - weight.mean((2, 3), keepdims=True)
        ),
        "weights over six decades, by output channel": layer(
            x, weight * decades[:, None, None, None]
        ),
        "weights over six decades, by input channel": layer(x, weight * decades[:, None, None]),
        "weights over six decades, one by one": layer(
            x, weight * 10 ** rng.uniform(-3, 3, weight.shape)
        ),
        "512 channels": layer(
            _normal(rng, 12, 12, 512), _normal(rng, 512, 512, 3, 3) / np.sqrt(4608)
        ),
        "background with one bright pixel": layer(bright, weight, none),
        "background alone": layer(np.zeros_like(x), weight, grad_out=np.zeros_like(x)),
        # a sum of equal numbers over the image, one by one, would lose three digits
        "one colour": layer(
            np.full((64, 257, 16), 1.1), weight[:16, :16], grad_out=np.full((64, 257, 16), 0.7)
        ),
        "weights of 6e4": layer(x, 6e4 * np.sign(weight)),
        "weights of 1e-7": layer(x, 1e-7 * np.sign(weight), none),
        "output channels of 6e4 and of 1e-7": layer(x, weight * limits[:, None, None, None]),
        "inputs and gradients of 6e4": layer(
            6e4 * np.sign(x), weight, grad_out=6e4 * np.sign(_normal(rng, *x.shape))
        ),
        "inputs and gradients of 1e-7": layer(
            1e-7 * x, weight, none, 1e-7 * _normal(rng, *x.shape)
        ),
    }


def _normal(rng, *shape):
    return rng.normal(size=shape).astype(np.float32)
