"""The blend of features by their weights, and its gradients gathered by point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, row_parts
from pp_cl.raster.alpha import Alpha
from pp_cl.raster.blend_weights import BlendWeights, PixelWeights
from pp_cl.raster.pairs import Pairs
from pp_cl.raster.softmax import Softmax

BLENDS: dict[str, type[BlendWeights]] = {"softmax": Softmax, "alpha": Alpha}  # raster.blend
BACKGROUND = 1.0  # every feature of a pixel without hits (cl/raster/blend.cl)


@dataclass(frozen=True)
class BlendGradient:
    """What all gradients of one blend are made of.

    point_features: (N, 16), as in Blend.forward. grad_features: (H, W, 16), G = dL/dF.
    rest_or_gain: of BlendWeights. All float32.
    """

    pairs: Pairs
    weights: PixelWeights
    point_features: Array
    grad_features: Array
    rest_or_gain: Array


class Blend:
    """Blends features by PixelWeights.

    weighing: what computes them. mean_gradient: a point's gradients are divided by its number of
    tracked pixels, as Pulsar does.
    """

    def __init__(
        self,
        dev: Device,
        weighing: BlendWeights,
        mean_gradient: bool = False,
    ):
        self.dev = dev
        self.weighing = weighing
        self._row_parts = row_parts(dev, on_gpu=4)
        self.defines = {
            "LANES": lanes(dev, on_gpu=4),  # each work-item reads whole rows for its dot products
            "MEAN": int(mean_gradient),
            "GAIN_BY_PAIR": int(weighing.gain_by_pair),
        }
        self._buffers = Buffers(dev)

    @staticmethod
    def table(n: int) -> Table:
        """The buffers for n points."""
        return {
            "grad_point_features": ((n, 16), np.float32),
            "grad_opacity": ((n,), np.float32),
        }

    def forward(
        self, pairs: Pairs, weights: PixelWeights, point_features: Array, features: Array
    ) -> None:
        """Write features (H, W, 16) from point_features (N, 16), both float32.

        Of point_features only the rows weights.shaded are read.
        """
        self._program(weights).launch(
            "blend_forward",
            pairs.pixels * self._row_parts,
            hw=pairs.pixels,
            pixel_offset=pairs.pixel_offset,
            pixel_entry=weights.pixel_entry,
            point_features=point_features,
            features=features,
        )

    def gradient(
        self,
        pairs: Pairs,
        weights: PixelWeights,
        point_features: Array,
        *,
        features: Array,
        grad_features: Array,
        grad_alpha: Array | None = None,
        spread_weight: float = 0.0,
    ) -> BlendGradient:
        """Prepare the backward pass of forward(pairs, weights, point_features, features).

        grad_alpha, spread_weight: as BlendWeights.rest_or_gain takes them.
        """
        self._buffers.require(self.table(pairs.points))
        rest_or_gain = self.weighing.rest_or_gain(
            pairs,
            weights,
            point_features,
            features=features,
            grad_features=grad_features,
            grad_alpha=grad_alpha,
            spread_weight=spread_weight,
        )
        return BlendGradient(pairs, weights, point_features, grad_features, rest_or_gain)

    def backward(self, gradient: BlendGradient) -> tuple[Array, Array]:
        """(grad_point_features (N, 16), grad_opacity (N,)) float32, valid until the next call.

        Points that are not shaded get zeros.
        """
        grads = self._buffers.grad_point_features, self._buffers.grad_opacity
        pairs, weights = gradient.pairs, gradient.weights
        self._program(weights).launch(
            "blend_backward",
            pairs.points * self._row_parts,
            n=pairs.points,
            point_features=gradient.point_features,
            point_offset=pairs.point_offset,
            pair_pixel=pairs.pair_pixel,
            pair_weight=weights.pair_weight,
            pair_role=weights.pair_role,
            grad_features=gradient.grad_features,
            rest_or_gain=gradient.rest_or_gain,
            grad_point_features=grads[0],
            grad_opacity=grads[1],
        )
        return grads

    def _program(self, weights):
        return self.dev.program("raster/blend", HAS_ROLES=int(weights.has_roles), **self.defines)
