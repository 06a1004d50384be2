"""The direct convolutions behind the interface of all variants (variants.Convolution)."""

import math
from dataclasses import dataclass

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.blocking import Blocking
from pp_cl.layers.conv import conv_backward_input, conv_forward
from pp_cl.layers.conv_backward_weights import conv_backward_weights, flip_weights, partial_floats
from pp_cl.layers.direction import Direction
from pp_cl.layers.tiles import LANES, Tiles
from pp_cl.layers.work import Work


@dataclass(frozen=True)
class DirectConvolution:
    """Kernels of cl/layers/conv.cl and conv_backward_weights.cl: any channels, 1x1 and 3x3."""

    dev: Device
    blocking: Blocking

    def work_floats(
        self, direction: Direction, height: int, weight_shape: tuple, c: int
    ) -> tuple[int, int]:
        """As variants.Convolution.work_floats."""
        if direction is Direction.BACKWARD_WEIGHTS:
            return 0, partial_floats(height, weight_shape)
        flipped = math.prod(_flipped_shape(weight_shape, c, weight_shape[0] * LANES))
        return 0, flipped if direction is Direction.BACKWARD_INPUT else 0

    def lay_out(self, weight: Array) -> None:
        """None: the kernels read the weights as they are."""

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
        """As variants.Convolution.forward."""
        conv_forward(
            self.dev,
            sources,
            weight,
            bias,
            out=out,
            relu=relu,
            tiles=tiles,
            blocking=self.blocking,
        )

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
        """As variants.Convolution.backward_input."""
        shape = _flipped_shape(weight.shape, grad_x.shape[2], grad_out.shape[2])
        flipped = work.weights[: math.prod(shape)].reshape(shape)
        flip_weights(self.dev, weight, first, flipped, blocking=self.blocking)
        self._backward_input(flipped, grad_out, grad_x, mask=mask, tiles=tiles)

    def _backward_input(self, flipped, grad_out, grad_x, **given):
        conv_backward_input(self.dev, flipped, grad_out, grad_x, blocking=self.blocking, **given)

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
        """As variants.Convolution.backward_weights."""
        conv_backward_weights(
            self.dev,
            sources,
            grad_out,
            grad_weight,
            grad_bias=grad_bias,
            partial=work.weights,
            tiles=tiles,
            blocking=self.blocking,
        )


def _flipped_shape(weight_shape, c, co):
    """Shape of the flipped weights of c input channels."""
    return -(-c // LANES), *weight_shape[1:3], co, LANES
