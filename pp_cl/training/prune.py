"""Which points to drop because they contribute nothing."""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.errors import Diverged
from pp_cl.settings import TrainConfig
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
    weight, opacity = dev.download(weights), dev.download(opacities)
    return _listed(dev, (weight >= least_weight) & (opacity >= least_opacity), weight)


def judge(dev: Device, state: PointState, opacities: Array, settings: TrainConfig) -> Array:
    """The same by the looks of training: a point that was looked at train.prune_looks times must
    have weighed train.prune_weight in one of them, and have train.prune_opacity; both start anew.

    Others stay. A mean over the looks would drop what few views see, such as the inside of a gap.
    Raises Diverged for weights and opacities that are not finite: nothing would tell of them later.
    """
    arrays = (state.peak_weight, state.look_count, opacities)
    peak, looks, opacity = (dev.download(array) for array in arrays)
    broken = int((~np.isfinite(peak) | ~np.isfinite(opacity)).sum())
    if broken:
        raise Diverged(f"{broken} points have a weight or an opacity that is not finite")
    judged = looks >= settings.prune_looks
    passes = (peak >= settings.prune_weight) & (opacity >= settings.prune_opacity)
    for array, values in ((state.peak_weight, peak), (state.look_count, looks)):
        dev.write(array, np.where(judged, np.float32(0), values))
    return _listed(dev, ~judged | passes, peak)


def _listed(dev, keep, weight):
    """Indices of the points to keep, at least one."""
    indices = np.flatnonzero(keep)
    if indices.size == 0:
        indices = [np.argmax(np.nan_to_num(weight, nan=-np.inf))]
    return dev.upload(indices, np.uint32)
