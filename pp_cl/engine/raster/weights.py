"""Computes the blend weight of each fragment in its pixel, by alpha compositing or by the paper's
softmax; lists the visible points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import replayed
from pp_cl.engine.device.scan import nonzero, read_total
from pp_cl.engine.raster.footprint import sample_macros
from pp_cl.engine.raster.pairs import Pairs
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.raster.softmax import softmax_weights

BLENDS = ("softmax", "alpha")
NO_POINT = 0xFFFFFFFF  # ends a pixel's list in pixel_weight_point if fragments were dropped
ALL = 2**32 - 1  # BlendWeights.tracked if all fragments get gradients


@dataclass
class BlendWeights:
    """The blend weights of a Pairs object, valid until the next ones are computed.

    blend: one of BLENDS. opacity, early_stop: the arguments of blend_weights(). tracked: how many
    nearest fragments of a pixel get gradients. pixel_weight_point: (P,) uint64, weight bits << 32 |
    point, each pixel's fragments by depth; where fragments are dropped, NO_POINT ends the pixel's
    list. pixel_derivative: (P, samples) float32 in the same order, the factor s of the backward
    pass, dL/dopacity = s * dL/db (cl/raster/blend.cl); None without derivatives.

    point_is_visible: (N,) uint8, 1 for visible points. point_slot: (N,) uint32, the index of a
    visible point in `visible`, undefined for others. transmittance: (HW,) float32 behind all
    fragments, None with the softmax; sample_transmittance: (HW, samples), the same by sample, None
    without derivatives, too. visible_rows: (N,) uint32, begins with `visible`; found: (1,) uint32,
    the number of visible points; count: that number, downloaded by read_count().
    """

    blend: str
    opacity: Array
    early_stop: float
    tracked: int
    pixel_weight_point: Array
    pixel_derivative: Array | None
    point_is_visible: Array
    point_slot: Array
    transmittance: Array | None
    visible_rows: Array
    found: Array
    sample_transmittance: Array | None = None
    count: Any = None

    def read_count(self, dev: Device) -> None:
        """Enqueue the download of the number of visible points."""
        self.count = read_total(dev, self.found)

    @property
    def total(self) -> int:
        """The number of visible points, S; waits until it is known."""
        return self.count.get()

    @property
    def visible(self) -> Array:
        """(S,) uint32, ascending: the visible points, which have a fragment that is not dropped.
        Only they are shaded and get gradients. Waits until their number is known.
        """
        return self.visible_rows[: self.total]


def weights_table(n: int, pixels: int, derivatives: int, side: int = 1) -> Table:
    """The buffers for n points, a number of pixels with side x side samples each, and a number of
    derivatives, 0 for none; pixel_weight_point uses pair_scratch of pairs_table().
    """
    table: Table = {
        "transmittance": ((pixels,), np.float32),
        "point_is_visible": ((n,), np.uint8),
        "visible": ((n,), np.uint32),
        "point_slot": ((n,), np.uint32),
        "visible_count": ((1,), np.uint32),
    }
    if derivatives:
        table["sample_transmittance"] = (pixels, side**2), np.float32
        table["pixel_derivative"] = (derivatives, side**2), np.float32
    return table


@replayed
def blend_weights(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    pairs: Pairs,
    opacity: Array,
    *,
    blend: str,
    gamma: float,
    max_tracked: int = 0,
    early_stop: float = 0.0,
    derivatives: bool = True,
) -> BlendWeights:
    """The weights of all pairs of these points, in the buffers b of find_pairs().

    opacity: (N,) float32 in [0, 1]. blend: one of BLENDS; a pixel with several samples needs
    "alpha", and discs. gamma: depth sharpness of the softmax. max_tracked: only this many nearest
    fragments of a pixel get gradients (64 in the paper); 0: all. early_stop: in [0, 1): a pixel
    drops all fragments behind the depth where no fragment can have this share any more (0.001 in
    the paper); 0: none. derivatives: write what the backward pass reads. read_count() downloads the
    number of visible points.
    """
    side, capacity = points.side, pairs.capacity if derivatives else 0
    b.require(weights_table(pairs.points, pairs.pixels, capacity, side))
    dev.fill(b.point_is_visible, 0)
    derivative = b.pixel_derivative if derivatives else None
    sample_transmittance = b.sample_transmittance if derivatives else None
    shared: dict[str, Any] = {
        "hw": pairs.pixels,
        "early_stop": early_stop,
        "camera": points.camera_buffer,
        "pixel_offset": pairs.pixel_offset,
        "pair_key": pairs.pair_key,
        "pair_point_falloff": pairs.pair_point_falloff,
        "opacity": opacity,
        "pixel_weight_point": b.pair_scratch,
        "pixel_derivative": derivative,
        "point_is_visible": b.point_is_visible,
    }
    if blend == "alpha":
        macros = sample_macros(dev, points.footprint, side)
        dev.program("raster/alpha", DERIVATIVES=int(derivatives), **macros).launch(
            "alpha_weights",
            pairs.pixels,
            point_camera=points.point_camera,
            point_shape=points.point_shape,
            transmittance=b.transmittance,
            sample_transmittance=sample_transmittance,
            **shared,
        )
    else:
        softmax_weights(dev, pairs.pixels, gamma, derivatives, **shared)
    nonzero(dev, b.point_is_visible, b.visible, b.point_slot, b.visible_count)
    return BlendWeights(
        blend,
        opacity,
        early_stop,
        max_tracked or ALL,
        b.pair_scratch,
        derivative,
        b.point_is_visible,
        b.point_slot,
        b.transmittance if blend == "alpha" else None,
        b.visible,
        b.visible_count,
        sample_transmittance if blend == "alpha" else None,
    )


def listed_fragments(
    pairs: Pairs, weights: BlendWeights
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Download the fragments in the order of pairs.pair_key: (P,) bool, False if the fragment is
    dropped, and the uint32 points and float32 weights of all others.
    """
    offset = pairs.pixel_offset.get().astype(np.int64)
    weight_point = weights.pixel_weight_point.get()[: pairs.total]
    point = (weight_point & np.uint64(NO_POINT)).astype(np.uint32)
    # entries behind NO_POINT in a pixel were never written
    ends = np.concatenate([[0], np.cumsum(point == NO_POINT)])
    is_listed = ends[1:] == np.repeat(ends[offset[:-1]], np.diff(offset))
    return (
        is_listed,
        point[is_listed],
        (weight_point[is_listed] >> np.uint64(32)).astype(np.uint32).view(np.float32),
    )


def clear_pairs(dev: Device, pairs: Pairs, weights: BlendWeights, pair_gradient: Array) -> None:
    """Set pair_gradient, (P, 1 + samples) float32, to 0 at the pairs of visible points."""
    count = weights.total
    dev.program("raster/clear_pairs", SAMPLES=pair_gradient.shape[1] - 1).launch(
        "clear_pairs",
        count,
        s=count,
        visible=weights.visible_rows,
        point_offset=pairs.point_offset,
        pair_gradient=pair_gradient,
    )
