"""Pruning: which points to keep, by their highest blend weight and their opacity."""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.errors import Diverged
from pp_cl.settings import TrainConfig
from pp_cl.training.state import PointState


def points_to_keep(dev: Device, state: PointState, opacity: Array, settings: TrainConfig) -> Array:
    """(M,) uint32, ascending: the points that are kept during training. A point is judged once
    train.prune_looks steps had it in their image: it is kept if its blend weight reached
    train.prune_weight in one of them and its opacity is at least train.prune_opacity, and its
    counts start anew. Points seen less often are kept.

    The maximum decides, as a mean would drop what few views see, such as the inside of a gap.
    Raises Diverged for weights and opacities that are not finite, which nothing later would find.
    """
    weight, seen, opacity = map(dev.download, (state.max_weight, state.times_seen, opacity))
    broken = int((~np.isfinite(weight) | ~np.isfinite(opacity)).sum())
    if broken:
        raise Diverged(f"{broken} points have a weight or an opacity that is not finite")
    judged = seen >= settings.prune_looks
    passes = (weight >= settings.prune_weight) & (opacity >= settings.prune_opacity)
    dev.write(state.max_weight, np.where(judged, np.float32(0), weight))
    dev.write(state.times_seen, np.where(judged, np.float32(0), seen))
    return _listed(dev, ~judged | passes, weight)


def final_points_to_keep(
    dev: Device, max_weight: Array, opacity: Array, settings: TrainConfig
) -> Array:
    """(M,) uint32, ascending: the points of a finished training that weigh at least
    train.final_prune_weight and have train.prune_opacity. NaN counts as too little.

    max_weight: (N,) float32, the highest blend weight in a training view.
    """
    weight, opacity = dev.download(max_weight), dev.download(opacity)
    keep = (weight >= settings.final_prune_weight) & (opacity >= settings.prune_opacity)
    return _listed(dev, keep, weight)


def _listed(dev, keep, weight):
    """Indices of the points to keep; if there are none, that of the highest weight."""
    indices = np.flatnonzero(keep)
    if indices.size == 0:
        indices = [np.argmax(np.nan_to_num(weight, nan=-np.inf))]
    return dev.upload(indices, np.uint32)
