"""The blend of Eq. (1), a softmax over the hits of a pixel, and its early stop."""

from __future__ import annotations

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.launch import lanes
from pp_cl.raster.blend_weights import BlendWeights, PixelWeights
from pp_cl.raster.pairs import Pairs


class Softmax(BlendWeights):
    """The weights of Eq. (1). early_stop is Pulsar's percent_allowed_difference (0.001 in the
    paper).
    """

    gain_by_pair = False

    @classmethod
    def own_table(cls, pixels: int, pairs: int) -> Table:
        """As BlendWeights."""
        return {"rest": ((pixels,), np.float32)}

    def compute(
        self,
        pairs: Pairs,
        camera_buffer: Array,
        opacity: Array,
        gamma: float,
        *,
        max_tracked: int = 0,
        early_stop: float = 0.0,
    ) -> PixelWeights:
        """As BlendWeights."""
        has_roles = early_stop > 0 or max_tracked > 0
        pair_weight, pair_role, pixel_entry = self._reserve(pairs, has_roles)
        self._program = self.dev.program(
            "raster/softmax",
            LANES=lanes(self.dev),
            DROPS=int(early_stop > 0),
            MAX_TRACKED=max_tracked,
        )
        self._program.launch(
            "softmax_weights",
            pairs.pixels,
            hw=pairs.pixels,
            gamma=gamma,
            early_stop=early_stop,
            camera=camera_buffer,
            pixel_offset=pairs.pixel_offset,
            pair_key=pairs.pair_key,
            pair_point_closeness=pairs.pair_point_closeness,
            opacity=opacity,
            pair_weight=pair_weight,
            pair_role=pair_role,
            pixel_entry=pixel_entry,
        )
        shaded = self._list_shaded(pairs, pixel_entry)
        return PixelWeights(has_roles, pair_weight, pair_role, pixel_entry, shaded)

    def rest_or_gain(
        self,
        pairs: Pairs,
        weights: PixelWeights,
        point_features: Array,
        *,
        features: Array,
        grad_features: Array,
        grad_alpha: Array | None = None,
        spread_weight: float = 0.0,
    ) -> Array:
        """As BlendWeights: G.F of each pixel."""
        if grad_alpha is not None or spread_weight > 0:
            raise ValueError("a softmax has no gradient of alpha and of spread")
        rest = self._buffers.rest
        self._program.launch(
            "softmax_rest",
            pairs.pixels,
            hw=pairs.pixels,
            features=features,
            grad_features=grad_features,
            rest=rest,
        )
        return rest
