"""Which points to drop because they contribute nothing."""

import numpy as np
from pyopencl.array import Array

from pp_cl.config import TrainConfig
from pp_cl.device.device import Device
from pp_cl.training.point_state import PointState


def keep_indices(
    dev: Device,
    weights: Array,
    least_weight: float,
    opacities: Array,
    *,
    least_opacity: float,
) -> Array:
    """(M,) uint32, ascending: the points with weight >= least_weight and opacity >= least_opacity.

    weights, opacities: (N,) float32. NaN counts as too little. Where no point would remain, the
    one of the highest weight does (the first of several).
    """
    weight = weights.get()
    return _listed(dev, (weight >= least_weight) & (opacities.get() >= least_opacity), weight)


def judge(dev: Device, state: PointState, opacities: Array, settings: TrainConfig) -> Array:
    """The same by the weights of training: a point that was looked at train.prune_looks times must
    have weighed train.prune_weight a look, and have train.prune_opacity; its count starts anew.

    Others stay: what was not looked at may have been hidden by what is still fog.
    """
    weight, looks = state.weight_sum.get(), state.look_count.get()
    judged = looks >= settings.prune_looks
    passes = (weight >= settings.prune_weight * looks) & (opacities.get() >= settings.prune_opacity)
    for sums, values in ((state.weight_sum, weight), (state.look_count, looks)):
        sums.set(np.where(judged, np.float32(0), values))
    return _listed(dev, ~judged | passes, weight)


def _listed(dev, keep, weight):
    """Indices of the points to keep, at least one."""
    indices = np.flatnonzero(keep)
    if indices.size == 0:
        indices = [np.argmax(np.nan_to_num(weight, nan=-np.inf))]
    return dev.upload(indices, np.uint32)
