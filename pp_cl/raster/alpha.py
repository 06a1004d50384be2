"""Alpha compositing from front to back, and the hits that are dropped because hardly any light gets
to them.
"""

from __future__ import annotations

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.raster.blend_weights import DROPPED, BlendWeights, PixelWeights
from pp_cl.raster.pairs import Pairs


class Alpha(BlendWeights):
    """The weights T o d of cl/raster/alpha.cl. No hit behind early_stop could weigh more than that:
    it, and all behind it together, weigh T at most.
    """

    gain_by_pair = True

    @classmethod
    def own_table(cls, pixels: int, pairs: int) -> Table:
        """As BlendWeights."""
        return {"transmittance": ((pixels,), np.float32), "gain": ((pairs,), np.float32)}

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
        """As BlendWeights; camera and gamma do not matter."""
        has_roles = early_stop > 0 or max_tracked > 0
        pair_weight, pair_role, pixel_entry = self._reserve(pairs, has_roles)
        if early_stop > 0:
            self.dev.fill(pair_role, DROPPED)
        program = self.dev.program(
            "raster/alpha", DROPS=int(early_stop > 0), MAX_TRACKED=max_tracked
        )
        program.launch(
            "alpha_weights",
            pairs.pixels,
            hw=pairs.pixels,
            least=early_stop,
            pixel_offset=pairs.pixel_offset,
            pair_key=pairs.pair_key,
            pair_point_closeness=pairs.pair_point_closeness,
            opacity=opacity,
            pair_weight=pair_weight,
            pair_role=pair_role,
            pixel_entry=pixel_entry,
            transmittance=self._buffers.transmittance,
        )
        shaded = self._list_shaded(pairs, pixel_entry)
        transmittance = self._buffers.transmittance[: pairs.pixels]
        return PixelWeights(has_roles, pair_weight, pair_role, pixel_entry, shaded, transmittance)

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
        """As BlendWeights: G.f + g - B of each pair, B being G times what is composited behind."""
        gain = self._buffers.gain[: pairs.capacity]
        self.dev.program("raster/alpha", HAS_GRAD_ALPHA=int(grad_alpha is not None)).launch(
            "alpha_gain",
            pairs.pixels,
            hw=pairs.pixels,
            spread_weight=spread_weight,
            pixel_offset=pairs.pixel_offset,
            pair_key=pairs.pair_key,
            pixel_entry=weights.pixel_entry,
            transmittance=weights.transmittance,
            point_features=point_features,
            grad_features=grad_features,
            grad_alpha=weights.transmittance if grad_alpha is None else grad_alpha,
            gain=gain,
        )
        return gain
