"""Winograd's convolutions behind the interface of all variants (variants.Convolution)."""

from dataclasses import dataclass, replace

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.direction import Direction
from pp_cl.layers.tiles import LANES, Tiles
from pp_cl.layers.winograd import WinogradForm, winograd_backward_input, winograd_forward
from pp_cl.layers.winograd_backward_weights import (
    backward_weights_floats,
    winograd_backward_weights,
)
from pp_cl.layers.winograd_transform import transform_flipped_weights, transform_weights
from pp_cl.layers.work import Work


@dataclass(frozen=True)
class WinogradConvolution:
    """Kernels of cl/layers/winograd*.cl: 3x3, channels in multiples of 16."""

    dev: Device
    form: WinogradForm

    def work_floats(
        self, direction: Direction, height: int, weight_shape: tuple, c: int
    ) -> tuple[int, int]:
        """As variants.Convolution.work_floats."""
        if direction is Direction.BACKWARD_WEIGHTS:
            return backward_weights_floats(self.dev, self.form, weight_shape)
        co = weight_shape[0] * LANES
        return self.form.scratch_floats(self.dev, c, co), self.form.transformed_floats(c, co)

    def lay_out(self, weight: Array) -> Array:
        """Transformed weights in a new array."""
        blocks, _, _, ci, _ = weight.shape
        laid_out = self.dev.empty(self.form.transformed_floats(ci, blocks * LANES))
        transform_weights(self.dev, self.form, weight, laid_out)
        return laid_out

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
        if laid_out is None:
            transform_weights(self.dev, self.form, weight, work.weights)
        else:
            work = replace(work, weights=laid_out)
        winograd_forward(
            self.dev, self.form, sources, bias, out=out, relu=relu, work=work, tiles=tiles
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
        transform_flipped_weights(
            self.dev, self.form, weight, first, c=grad_x.shape[2], transformed=work.weights
        )
        winograd_backward_input(
            self.dev, self.form, grad_out, grad_x, mask=mask, work=work, tiles=tiles
        )

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
        """As variants.Convolution.backward_weights. It reads no weights: half changes nothing."""
        winograd_backward_weights(
            self.dev,
            self.form,
            sources,
            grad_out,
            grad_weight=grad_weight,
            grad_bias=grad_bias,
            work=work,
            tiles=tiles,
        )
