"""Which points to drop because they contribute nothing."""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device


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
    weight, opacity = weights.get(), opacities.get()
    keep = np.flatnonzero((weight >= least_weight) & (opacity >= least_opacity))
    if keep.size == 0:
        keep = [np.argmax(np.nan_to_num(weight, nan=-np.inf))]
    return dev.upload(keep, np.uint32)
