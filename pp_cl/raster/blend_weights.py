"""The blend weights of Eq. (1), and which hits are dropped because they change a pixel by less than
a bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table, grown
from pp_cl.device.device import Device
from pp_cl.device.scan import nonzero
from pp_cl.raster.pairs import Pairs


@dataclass(frozen=True)
class PixelWeights:
    """The blend weights of a Pairs object, valid until the next ones are computed.

    has_roles: some pairs may be untracked or dropped; else all are tracked and pair_role is unread.
    pair_weight: (P, 2) float32, the weight b of Eq. (1), and b (1/o + z/gamma), which times
    G.(f - F) is dL/do. pair_role: (P,) uint8, cl/raster/pair_role.h. pixel_entry: (P,) uint64,
    weight bits << 32 | point, each pixel's hits by depth; dropped hits end a pixel's list with an
    entry of no point that holds their weight. shaded: (S,) uint32, ascending, the points with a hit
    that is not dropped: no other point's features are read, no other point gets a gradient.
    """

    has_roles: bool
    pair_weight: Array
    pair_role: Array
    pixel_entry: Array
    shaded: Array


class BlendWeights:
    """Computes blend weights; the buffers grow and are reused."""

    def __init__(self, dev: Device):
        self.dev = dev
        self._buffers = Buffers(dev)
        self._capacity = 0

    @staticmethod
    def table(n: int, pairs: int, has_roles: bool) -> Table:
        """The buffers for n points and room for a number of pairs. has_roles: see PixelWeights."""
        always = {
            "pair_weight": ((pairs, 2), np.float32),
            "pair_role": ((pairs if has_roles else 1,), np.uint8),
            "pixel_entry": ((pairs,), np.uint64),
        }
        listing = {
            "point_is_shaded": ((n,), np.uint32),
            "point_place": ((n + 1,), np.uint32),
            "shaded": ((n,), np.uint32),
        }
        return always | listing if has_roles else always

    def compute(
        self,
        pairs: Pairs,
        camera_buffer: Array,
        opacity: Array,
        gamma: float,
        *,
        max_tracked: int = 0,
        early_stop: float = 0.0,
        tau: float = 0.0,
    ) -> PixelWeights:
        """The weights of all pairs.

        opacity: (N,) float32 in [0, 1]. max_tracked: only this many nearest hits of a pixel get
        gradients (64 in the paper); 0: all. early_stop: Pulsar's percent_allowed_difference, in
        [0, 1), 0.001 in the paper: a pixel drops all hits behind the depth where no hit can have
        this share any more; 0: none. tau: in [0, 1): a pixel drops hits, from the back on, whose
        weights sum to at most tau; no feature of the pixel changes by more than tau times the range
        of that feature over the pixel's points and the background. 0: none.
        """
        drops = early_stop > 0 or tau > 0
        has_roles = drops or max_tracked > 0
        p, b = max(1, pairs.total), self._buffers
        self._capacity = grown(self._capacity, p)
        b.require(self.table(pairs.points, self._capacity, has_roles))
        pair_weight, pixel_entry = b.pair_weight[:p], b.pixel_entry[:p]
        pair_role = b.pair_role[:p] if has_roles else b.pair_role
        self._program(DROPS=int(drops), MAX_TRACKED=max_tracked).launch(
            "blend_weights_forward",
            pairs.pixels,
            hw=pairs.pixels,
            gamma=gamma,
            early_stop=early_stop,
            tau=tau,
            camera=camera_buffer,
            pixel_offset=pairs.pixel_offset,
            pair_key=pairs.pair_key,
            pair_point_closeness=pairs.pair_point_closeness,
            opacity=opacity,
            pair_weight=pair_weight,
            pair_role=pair_role,
            pixel_entry=pixel_entry,
        )
        shaded = self._list_shaded(pairs, pair_role) if drops else pairs.seen
        return PixelWeights(has_roles, pair_weight, pair_role, pixel_entry, shaded)

    def dropped(self, pairs: Pairs, weights: PixelWeights) -> Array:
        """(HW,) float32: the weight that tau dropped from each pixel, or a bound just above it; at
        most tau.
        """
        pixel_dropped = self.dev.empty((pairs.pixels,))
        self._program().launch(
            "dropped_weights",
            pairs.pixels,
            hw=pairs.pixels,
            pixel_offset=pairs.pixel_offset,
            pixel_entry=weights.pixel_entry,
            pixel_dropped=pixel_dropped,
        )
        return pixel_dropped

    def add_to_points(self, pairs: Pairs, weights: PixelWeights, point_weight: Array) -> None:
        """Add each point's blend weights, summed over the pixels, to point_weight (N,) float32."""
        self._program().launch(
            "add_point_weights",
            pairs.points,
            n=pairs.points,
            point_offset=pairs.point_offset,
            pair_weight=weights.pair_weight,
            point_weight=point_weight,
        )

    def _list_shaded(self, pairs, pair_role):
        """The points with a hit that is not dropped. Waits for the device."""
        n, b = pairs.points, self._buffers
        self._program().launch(
            "find_shaded_points",
            n,
            n=n,
            point_offset=pairs.point_offset,
            pair_role=pair_role,
            point_is_shaded=b.point_is_shaded,
        )
        return b.shaded[: nonzero(self.dev, b.point_is_shaded, b.point_place, b.shaded)]

    def _program(self, **defines):
        return self.dev.program("raster/blend_weights", **defines)
