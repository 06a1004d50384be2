"""Records each point's highest blend weight in an image, by which it is pruned."""

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.device import Device
from pp_cl.engine.raster.pairs import Pairs
from pp_cl.engine.raster.weights import BlendWeights, clear_pairs


def list_weights(dev: Device, b: Buffers, pairs: Pairs, weights: BlendWeights) -> Array:
    """(P, 2) float32, valid until the next call: for each pair of a visible point, its blend weight
    and 0; both are 0 if the pair is dropped or not tracked.
    """
    b.require({"pair_gradient": ((pairs.capacity, 2), np.float32)})
    clear_pairs(dev, pairs, weights, b.pair_gradient)
    dev.program("raster/highest_weights").launch(
        "list_weights",
        pairs.pixels,
        hw=pairs.pixels,
        tracked=weights.tracked,
        pixel_offset=pairs.pixel_offset,
        pair_key=pairs.pair_key,
        pixel_weight_point=weights.pixel_weight_point,
        pair_gradient=b.pair_gradient,
    )
    return b.pair_gradient


def record_weights(
    dev: Device,
    pairs: Pairs,
    weights: BlendWeights,
    pair_gradient: Array,
    max_weight: Array,
    times_seen: Array,
    least: float = 0.0,
) -> None:
    """Update the inputs of pruning, both (N,) float32. For each point, max_weight is the highest
    sum of its blend weights over an image's pixels so far, and times_seen counts the images in
    which it had a fragment, dropped or not, and this sum was at least `least`. pair_gradient: from
    list_weights().
    """
    dev.program("raster/highest_weights").launch(
        "record_weights",
        pairs.points,
        n=pairs.points,
        least=least,
        point_offset=pairs.point_offset,
        point_is_visible=weights.point_is_visible,
        pair_gradient=pair_gradient,
        max_weight=max_weight,
        times_seen=times_seen,
    )
