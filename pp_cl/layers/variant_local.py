"""The direct convolutions through local memory behind the interface of all variants
(variants.Convolution).
"""

from dataclasses import dataclass

from pyopencl.array import Array

from pp_cl.layers.conv_local import conv_local_backward_input, conv_local_forward
from pp_cl.layers.conv_local_backward_weights import conv_local_backward_weights
from pp_cl.layers.tiles import Tiles
from pp_cl.layers.variant_direct import DirectConvolution
from pp_cl.layers.work import Work


@dataclass(frozen=True)
class LocalConvolution(DirectConvolution):
    """Kernels of cl/layers/conv_local.cl and conv_local_backward_weights.cl: any channels, 1x1 and
    3x3. Weights and work memory are those of DirectConvolution.
    """

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
        conv_local_forward(self.dev, sources, weight, bias, out=out, relu=relu, tiles=tiles)

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
        conv_local_backward_weights(
            self.dev,
            sources,
            grad_out,
            grad_weight,
            grad_bias=grad_bias,
            partial=work.weights,
            tiles=tiles,
        )

    def _backward_input(self, flipped, grad_out, grad_x, **given):
        conv_local_backward_input(self.dev, flipped, grad_out, grad_x, **given)
