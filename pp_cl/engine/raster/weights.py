"""Walks along the tiles' lists, nearest points first, by alpha compositing or by the paper's
softmax: finds the points that show and what each sample lets through; lists the visible points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Pending, Table, read_later
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import replayed
from pp_cl.engine.device.scan import nonzero, read_total
from pp_cl.engine.layers.tiles import grid_shape
from pp_cl.engine.raster.pairs import TILE_SAMPLES, Pairs, launch_tiles
from pp_cl.engine.raster.project import ProjectedPoints, tiles_of

BLENDS = ("softmax", "alpha")
ALL = 2**32 - 1  # max_tracked if all fragments get gradients
# The least early_stop of alpha compositing: the way back divides by what a sample has let through.
LEAST_STOP = 1e-20


@dataclass
class BlendWeights:
    """What blend_weights() has found, valid until the next call. A sample's values lie by tile, by
    block of 16 samples and by sample, see cl/raster/tiles.h.

    blend: one of BLENDS. limit: early_stop of alpha compositing, 1 / gamma of the softmax.
    tile_shown: (TILES,) uint32, the number of points of each tile in Pairs.shown, which holds
    blocks << 32 | point.
    transmittance: (HW,) float32, the background's weight. mean_range: (HW,) float32, the mean
    distance from the eye of what a pixel shows, by weight, 0 where it shows nothing; not of the
    softmax. is_covered: (H/4, W/4) int32, whether a part of 4 x 4 pixels shows anything.
    sample_state: (2, BLOCKS, 16) float32, of alpha compositing, with derivatives: the transmittance
    behind all and the sum of weights times distances; of the softmax M and 1/D. sample_end: int32
    (BLOCKS, 16), how many of the tile's points are before a sample's early stop; sample_tracked:
    those that get gradients.

    point_is_visible: (N,) uint8, 1 for visible points. point_slot: (N,) uint32, the index of a
    visible point in `visible`, undefined for others. visible_rows: (N,) uint32, begins with
    `visible`; found: (1,) uint32, the number of visible points; count: that number, downloaded by
    read_count().
    """

    blend: str
    limit: float
    tile_shown: Array
    transmittance: Array
    mean_range: Array
    is_covered: Array
    sample_state: Array | None
    sample_end: Array | None
    sample_tracked: Array | None
    point_is_visible: Array
    point_slot: Array
    visible_rows: Array
    found: Array
    count: Any = None

    def read_count(self, dev: Device) -> None:
        """Enqueue the download of the number of visible points."""
        self.count = read_total(dev, self.found)

    def read_covered(self, dev: Device) -> Pending[np.ndarray]:
        """(H/4, W/4) bool: the parts of 4 x 4 pixels that show anything."""
        return read_later(dev, self.is_covered, convert=lambda flags: flags != 0)

    @property
    def total(self) -> int:
        """The number of visible points, S; waits until it is known."""
        return self.count.get()

    @property
    def visible(self) -> Array:
        """(S,) uint32, ascending: the visible points, which show in a sample. Only they are shaded
        and get gradients. Waits until their number is known.
        """
        return self.visible_rows[: self.total]

    def walk(self) -> dict[str, Any]:
        """The arguments, by name, with which a kernel walks along the points that show again, and
        the program's macros.
        """
        is_softmax = self.blend == "softmax"
        return {
            "limit": self.limit,
            "tile_shown": self.tile_shown,
            "sample_state": self.sample_state if is_softmax else None,
            "sample_end": self.sample_end if is_softmax else None,
            "defines": {"SOFTMAX": int(is_softmax)},
        }


def weights_table(
    n: int, size: tuple[int, int], blend: str, supersampling: int = 1, *, derivatives: bool
) -> Table:
    """The buffers for n points and an image of size (height, width). supersampling:
    samples of a pixel, each way.
    """
    (rows, columns), pixels = tiles_of(size, supersampling), size[0] * size[1]
    samples = rows * columns * TILE_SAMPLES // 16, 16
    table: Table = {
        "tile_shown": ((rows * columns,), np.uint32),
        "transmittance": ((pixels,), np.float32),
        "mean_range": ((pixels,), np.float32),
        "is_covered": (grid_shape(*size), np.int32),
        "point_is_visible": ((n,), np.uint8),
        "visible": ((n,), np.uint32),
        "point_slot": ((n,), np.uint32),
        "visible_count": ((1,), np.uint32),
    }
    if derivatives or blend == "softmax":
        table |= {"sample_state": ((2, *samples), np.float32), "sample_end": (samples, np.int32)}
    if blend == "softmax":
        table["sample_tracked"] = samples, np.int32
    return table


@replayed
def blend_weights(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    pairs: Pairs,
    *,
    blend: str,
    gamma: float,
    max_tracked: int = 0,
    early_stop: float = 0.0,
    derivatives: bool = True,
) -> BlendWeights:
    """The weights of these pairs' fragments, in the buffers b of find_pairs(), whose `shown` is
    written.

    blend: one of BLENDS; a pixel with several samples needs "alpha", and discs. gamma: depth
    sharpness of the softmax. max_tracked: of the softmax, only this many nearest fragments of a
    pixel get gradients (64 in the paper); 0: all. early_stop: in [0, 1): a sample drops all
    fragments behind the depth where no fragment can have this share any more (0.001 in the paper);
    0: none, of alpha compositing LEAST_STOP. derivatives: write what the backward pass reads.
    read_count() downloads the number of visible points.
    """
    n, is_alpha = len(points.point_count), blend == "alpha"
    b.require(weights_table(n, pairs.size, blend, points.supersampling, derivatives=derivatives))
    dev.fill(b.point_is_visible, 0)
    keeps = derivatives or not is_alpha
    state, end = (b.sample_state, b.sample_end) if keeps else (None, None)
    shared: dict[str, Any] = {
        "p": pairs.capacity,
        "pair_key": pairs.pair_key,
        "early_stop": max(early_stop, LEAST_STOP) if is_alpha else early_stop,
        "tile_shown": b.tile_shown,
        "point_is_visible": b.point_is_visible,
        "transmittance": b.transmittance,
        "is_covered": b.is_covered,
        "sample_state": state,
        "sample_end": end,
    }
    view = points, pairs
    if is_alpha:
        shared |= {"defines": {"DERIVATIVES": int(derivatives)}, "mean_range": b.mean_range}
        launch_tiles(dev, "raster/weights", "alpha_weights", *view, **shared)
    else:
        shared |= {"defines": {"DROPS": int(early_stop > 0)}, "sample_tracked": b.sample_tracked}
        shared |= {"sharpness": 1 / gamma, "tracked": max_tracked or ALL}
        launch_tiles(dev, "raster/softmax", "softmax_weights", *view, **shared)
    nonzero(dev, b.point_is_visible, b.visible, b.point_slot, b.visible_count)
    return BlendWeights(
        blend,
        shared["early_stop"] if is_alpha else 1 / gamma,
        b.tile_shown,
        b.transmittance,
        b.mean_range,
        b.is_covered,
        state,
        end,
        None if is_alpha else b.sample_tracked,
        b.point_is_visible,
        b.point_slot,
        b.visible,
        b.visible_count,
    )
