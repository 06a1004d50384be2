"""The blend weight of each hit in its pixel, by alpha compositing or by the paper's softmax; the
list of visible points, and each point's highest weight for pruning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Reading, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes
from pp_cl.device.scan import nonzero
from pp_cl.raster.pairs import Pairs

BLENDS = ("softmax", "alpha")
DROPPED = 2  # cl/raster/pair_role.h


@dataclass(frozen=True)
class BlendWeights:
    """The blend weights of a Pairs object, valid until the next ones are computed.

    blend: one of BLENDS. has_roles: some pairs may be untracked (no gradient) or dropped (behind
    the early stop); else pair_role is unread. pair_weight: (P, 2) float32, the blend weight b, and
    a factor s for the backward pass, dL/dopacity = s * gain (cl/raster/blend.cl); undefined where
    the pair is dropped. pair_role: (P,) uint8, cl/raster/pair_role.h. Neither is there without
    by_pair. point_is_shaded: (N,) uint8, 1 for visible points. pixel_entry: (P,) uint64,
    weight bits << 32 | point, each pixel's hits by depth; where hits are dropped, an entry without
    a point ends the pixel's list. shaded_list: `shaded`, whose length is still on its way.
    point_slot: (N,) uint32, where a visible point stands in `shaded`, undefined for others.
    transmittance: (HW,) float32 behind all hits, None with the softmax.
    """

    blend: str
    has_roles: bool
    pair_weight: Array
    pair_role: Array
    pixel_entry: Array
    point_is_shaded: Array
    shaded_list: Reading[Array]
    point_slot: Array
    transmittance: Array | None

    @property
    def shaded(self) -> Array:
        """(S,) uint32, ascending: the visible points, those with a hit that is not dropped. Only
        they are shaded and get gradients. Waits until their number is known.
        """
        return self.shaded_list.get()


def weights_table(n: int, pixels: int, by_pair: int, roles: int) -> Table:
    """The buffers for n points and a number of pixels, with room for numbers of weights and of
    roles by pair; those by pixel lie in pairs_table()'s pair_scratch.
    """
    return {
        "pair_weight": ((by_pair, 2), np.float32),
        "pair_role": ((roles,), np.uint8),
        "transmittance": ((pixels,), np.float32),
        "point_is_shaded": ((n,), np.uint8),
        "shaded": ((n,), np.uint32),
        "point_slot": ((n,), np.uint32),
    }


def blend_weights(
    dev: Device,
    b: Buffers,
    pairs: Pairs,
    camera_buffer: Array,
    opacity: Array,
    *,
    blend: str,
    gamma: float,
    max_tracked: int = 0,
    early_stop: float = 0.0,
    by_pair: bool = True,
) -> BlendWeights:
    """The weights of all pairs, in the buffers b of find_pairs().

    opacity: (N,) float32 in [0, 1]. blend: one of BLENDS. gamma: depth sharpness of the softmax.
    max_tracked: only this many nearest hits of a pixel get gradients (64 in the paper); 0: all.
    early_stop: in [0, 1): a pixel drops all hits behind the depth where no hit can have this share
    any more (0.001 in the paper); 0: none. by_pair: write what the backward pass and
    record_weights() read.
    """
    has_roles = early_stop > 0 or max_tracked > 0
    n, pixels, room = pairs.points, pairs.pixels, pairs.capacity if by_pair else 1
    b.require(weights_table(n, pixels, room, room if has_roles else 1))
    drops = {"MAX_TRACKED": max_tracked, "DROPS": int(early_stop > 0), "BY_PAIR": int(by_pair)}
    dev.fill(b.point_is_shaded, 0)
    if blend == "alpha":
        _alpha_weights(dev, b, pairs, opacity, early_stop, drops)
    else:
        _softmax_weights(dev, b, pairs, camera_buffer, opacity, gamma, early_stop, drops)
    shaded_list = nonzero(dev, b.point_is_shaded, b.shaded, b.point_slot)
    transmittance = b.transmittance if blend == "alpha" else None
    return BlendWeights(
        blend,
        has_roles,
        b.pair_weight,
        b.pair_role,
        b.pair_scratch,
        b.point_is_shaded,
        shaded_list,
        b.point_slot,
        transmittance,
    )


def _alpha_weights(dev, b, pairs, opacity, early_stop, drops):
    """Front to back, weight = transmittance * opacity * closeness; early_stop is the transmittance
    below which the hits behind are dropped.
    """
    if early_stop > 0:
        dev.fill(b.pair_role, DROPPED)
    dev.program("raster/alpha", **drops).launch(
        "alpha_weights",
        pairs.pixels,
        hw=pairs.pixels,
        early_stop=early_stop,
        pixel_offset=pairs.pixel_offset,
        pair_key=pairs.pair_key,
        pair_point_closeness=pairs.pair_point_closeness,
        opacity=opacity,
        pair_weight=b.pair_weight,
        pair_role=b.pair_role,
        pixel_entry=b.pair_scratch,
        transmittance=b.transmittance,
        point_is_shaded=b.point_is_shaded,
    )


def _softmax_weights(dev, b, pairs, camera_buffer, opacity, gamma, early_stop, drops):
    """Eq. (1) of the supplemental; early_stop is Pulsar's percent_allowed_difference."""
    dev.program("raster/softmax", LANES=lanes(dev), **drops).launch(
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
        pair_weight=b.pair_weight,
        pair_role=b.pair_role,
        pixel_entry=b.pair_scratch,
        point_is_shaded=b.point_is_shaded,
    )


def record_weights(
    dev: Device,
    pairs: Pairs,
    weights: BlendWeights,
    max_weight: Array,
    times_seen: Array,
    least: float = 0.0,
) -> None:
    """Update what pruning looks at, both (N,) float32: max_weight, the highest sum over an image's
    pixels of a point's blend weights so far, and times_seen, how many images had a hit of the
    point, dropped or not, and such a sum of at least `least`.
    """
    dev.program("raster/weights", HAS_ROLES=int(weights.has_roles)).launch(
        "record_weights",
        pairs.points,
        n=pairs.points,
        least=least,
        point_offset=pairs.point_offset,
        point_is_shaded=weights.point_is_shaded,
        pair_weight=weights.pair_weight,
        pair_role=weights.pair_role,
        max_weight=max_weight,
        times_seen=times_seen,
    )
