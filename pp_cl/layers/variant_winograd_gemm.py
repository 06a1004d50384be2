"""Winograd's convolutions for GPUs behind the interface of all variants (variants.Convolution)."""

from dataclasses import dataclass, replace

from pyopencl.array import Array

from pp_cl.layers.direction import Direction
from pp_cl.layers.tiles import LANES, Tiles
from pp_cl.layers.variant_local import LocalConvolution
from pp_cl.layers.winograd_gemm import (
    scratch_floats,
    transformed_floats,
    winograd_gemm_backward_input,
    winograd_gemm_forward,
    winograd_gemm_weights,
)
from pp_cl.layers.work import Work


@dataclass(frozen=True)
class WinogradGemmConvolution(LocalConvolution):
    """Kernels of cl/layers/winograd_gemm.cl: 3x3, channels in multiples of 16. The gradient of the
    weights is LocalConvolution's.

    m: side of a tile of outputs, 2 or 4.
    """

    m: int

    def work_floats(
        self, direction: Direction, height: int, weight_shape: tuple, c: int
    ) -> tuple[int, int]:
        """As variants.Convolution.work_floats."""
        if direction is Direction.BACKWARD_WEIGHTS:
            return super().work_floats(direction, height, weight_shape, c)
        channels = c, weight_shape[0] * LANES
        if direction is Direction.BACKWARD_INPUT:
            channels = channels[::-1]
        return scratch_floats(self.dev, self.m, *channels), transformed_floats(self.m, *channels)

    def lay_out(self, weight: Array) -> Array:
        """Transformed weights in a new array."""
        blocks, _, _, ci, _ = weight.shape
        laid_out = self.dev.empty(transformed_floats(self.m, ci, blocks * LANES))
        winograd_gemm_weights(self.dev, self.m, weight, laid_out)
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
            winograd_gemm_weights(self.dev, self.m, weight, work.weights)
        else:
            work = replace(work, weights=laid_out)
        winograd_gemm_forward(
            self.dev, self.m, sources, bias, out=out, relu=relu, work=work, tiles=tiles
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
        flipped = range(first, first + grad_x.shape[2])
        winograd_gemm_weights(self.dev, self.m, weight, work.weights, flipped=flipped)
        winograd_gemm_backward_input(
            self.dev, self.m, grad_out, grad_x, mask=mask, work=work, tiles=tiles
        )
