"""Records each point's highest blend weight in an image, by which it is pruned."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes
from pp_cl.engine.raster.pairs import Pairs, launch_tiles
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.raster.weights import BlendWeights


def recording_table(pairs: int) -> Table:
    """The buffers of record_weights() for a capacity of pairs."""
    return {"pair_weight": ((pairs,), np.float32)}


def record_weights(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    max_weight: Array,
    times_seen: Array,
    least: float = 0.0,
) -> None:
    """Update the inputs of pruning, both (N,) float32. For each point, max_weight is the highest
    sum of its blend weights over an image's pixels so far, and times_seen counts the images in
    which its box lay and this sum was at least `least`. pairs: numbered by point.
    """
    b.require(recording_table(pairs.capacity))
    dev.fill(b.pair_weight, 0)
    of_pairs: dict[str, Any] = {"point_offset": pairs.point_offset, "pair_weight": b.pair_weight}
    name = "raster/highest_weights"
    launch_tiles(dev, name, "pair_weights", points, pairs, **of_pairs, **weights.walk())
    n = len(weights.point_is_visible)
    dev.program("raster/gather", LANES=lanes(dev), MOVED=0, **points.macros()).launch(
        "record_weights",
        n,
        n=n,
        least=least,
        point_is_visible=weights.point_is_visible,
        max_weight=max_weight,
        times_seen=times_seen,
        **of_pairs,
    )
