"""What the two blends have in common: the weights of a view's pairs, and what they mean for the
points.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.scan import nonzero
from pp_cl.device.transfer import Reading
from pp_cl.raster.pairs import Pairs

DROPPED = 2  # cl/raster/pair_role.h


@dataclass(frozen=True)
class PixelWeights:
    """The blend weights of a Pairs object, valid until the next ones are computed.

    has_roles: some pairs may be untracked or dropped; else all are tracked and pair_role is unread.
    pair_weight: (P, 2) float32, the weight b, and s, which times G.f - rest is dL/do
    (cl/raster/blend.cl); undefined where the pair is dropped. pair_role: (P,) uint8,
    cl/raster/pair_role.h. pixel_entry: (P,) uint64, weight bits << 32 | point, each pixel's hits by
    depth; where hits are dropped, an entry of no point ends a pixel's list. shaded_list: `shaded`
    before its length is known. transmittance: (HW,) float32, what is left for the background, None
    of a softmax.
    """

    has_roles: bool
    pair_weight: Array
    pair_role: Array
    pixel_entry: Array
    shaded_list: Reading[Array]
    transmittance: Array | None = None

    @property
    def shaded(self) -> Array:
        """(S,) uint32, ascending, the points with a hit that is not dropped: no other point's
        features are read, no other point gets a gradient. Waits until their number is known.
        """
        return self.shaded_list.get()


class BlendWeights(ABC):
    """Computes blend weights and what their gradients need; the buffers grow and are reused.

    gain_by_pair: rest_or_gain() gives the gain of each pair, else the rest of each pixel.
    """

    gain_by_pair: bool

    def __init__(self, dev: Device):
        self.dev = dev
        self._buffers = Buffers(dev)
        self._capacity = 0

    @staticmethod
    def table(n: int, pairs: int, has_roles: bool) -> Table:
        """The buffers for n points and room for a number of pairs. has_roles: see PixelWeights."""
        return {
            "pair_weight": ((pairs, 2), np.float32),
            "pair_role": ((pairs if has_roles else 1,), np.uint8),
            "pixel_entry": ((pairs,), np.uint64),
            "point_is_shaded": ((n,), np.uint8),
            "shaded": ((n,), np.uint32),
        }

    @classmethod
    @abstractmethod
    def own_table(cls, pixels: int, pairs: int) -> Table:
        """The buffers of one blend beside those of table()."""

    @abstractmethod
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
        """The weights of all pairs.

        opacity: (N,) float32 in [0, 1]. gamma: depth sharpness of the softmax. max_tracked: only
        this many nearest hits of a pixel get gradients (64 in the paper); 0: all. early_stop: in
        [0, 1): a pixel drops all hits behind the depth where no hit can have this share any more;
        0: none.
        """

    @abstractmethod
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
        """(HW,) float32: what G.f of a hit is compared with; with gain_by_pair (P,): by how much
        it exceeds that.

        weights: the last ones computed. point_features: (N, 16); features, grad_features: F and
        G, (H, W, 16), of Blend.forward with these weights. grad_alpha: g = dL/d(1 - T), (HW,), of
        weights with a transmittance; None: 0. spread_weight: adds this times sum_ij b_i b_j |z_i -
        z_j| of every pixel to the loss, with b and z the weights and depths (world units) of its
        hits, for weights with a transmittance; no gradient of the depths is formed.
        """

    def _reserve(self, pairs, has_roles):
        """The buffers (pair_weight, pair_role, pixel_entry) for these pairs."""
        p, b = pairs.capacity, self._buffers
        self._capacity = max(self._capacity, p)
        table = self.table(pairs.points, self._capacity, has_roles)
        b.require(table | self.own_table(pairs.pixels, self._capacity))
        pair_role = b.pair_role[:p] if has_roles else b.pair_role
        return b.pair_weight[:p], pair_role, b.pixel_entry[:p]

    def raise_peaks(
        self, pairs: Pairs, weights: PixelWeights, point_peak: Array, point_looks: Array
    ) -> None:
        """Raise point_peak to each point's blend weights, summed over the pixels, where they are
        higher, and add 1 to point_looks where it has a hit, dropped or not; both (N,) float32.
        """
        self._shared(weights).launch(
            "raise_point_peaks",
            pairs.points,
            n=pairs.points,
            point_offset=pairs.point_offset,
            pair_weight=weights.pair_weight,
            pair_role=weights.pair_role,
            point_peak=point_peak,
            point_looks=point_looks,
        )

    def _list_shaded(self, pairs, pixel_entry):
        """The points with a hit that is not dropped."""
        b = self._buffers
        self.dev.fill(b.point_is_shaded, 0)
        self.dev.program("raster/blend_weights").launch(
            "find_shaded_points",
            pairs.pixels,
            hw=pairs.pixels,
            pixel_offset=pairs.pixel_offset,
            pixel_entry=pixel_entry,
            point_is_shaded=b.point_is_shaded,
        )
        return nonzero(self.dev, b.point_is_shaded, b.shaded)

    def _shared(self, weights):
        return self.dev.program("raster/blend_weights", HAS_ROLES=int(weights.has_roles))
