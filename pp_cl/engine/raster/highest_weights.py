"""Records each point's highest blend weight in an image, by which it is pruned."""

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.raster.pairs import Pairs
from pp_cl.engine.raster.weights import BlendWeights


def record_weights(
    dev: Device,
    pairs: Pairs,
    weights: BlendWeights,
    max_weight: Array,
    times_seen: Array,
    least: float = 0.0,
) -> None:
    """Update the inputs of pruning, both (N,) float32. For each point, max_weight is the highest
    sum of its blend weights over an image's pixels so far, and times_seen counts the images in
    which its box lay and this sum was at least `least`. weights: with pair_weight.
    """
    n = len(weights.point_is_visible)
    dev.program("raster/highest_weights").launch(
        "record_weights",
        n,
        n=n,
        least=least,
        point_offset=pairs.point_offset,
        point_is_visible=weights.point_is_visible,
        pair_weight=weights.pair_weight,
        max_weight=max_weight,
        times_seen=times_seen,
    )
