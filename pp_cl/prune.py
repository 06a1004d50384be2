"""Dropping points that contribute nothing, with everything that is stored per point."""

import numpy as np


def keep_indices(dev, weights, least_weight, opacities, least_opacity):
    """(M,) uint32, ascending: the points with weight >= least_weight and opacity >= least_opacity.

    weights, opacities: (N,) float32 on the device. NaN counts as too little. Where no point would be left, the one of the
    highest weight is (the first of several).
    """
    weight, opacity = weights.get(), opacities.get()
    keep = np.flatnonzero((weight >= least_weight) & (opacity >= least_opacity))
    if keep.size == 0:
        keep = [np.argmax(np.nan_to_num(weight, nan=-np.inf))]
    return dev.upload(keep, np.uint32)


def gather_rows(dev, source, indices):
    """The rows `indices` of `source` as a new array.

    source: (N, ...) of a 4-byte dtype. indices: (M,) uint32, each below N. Result: (M, ...) of the same dtype.
    """
    m = len(indices)
    target = dev.empty((m, *source.shape[1:]), source.dtype)
    words = int(np.prod(source.shape[1:], dtype=np.int64))
    dev.program("prune").launch("gather_rows", m, m=m, r=words, indices=indices,
                                source=source.view(np.uint32).reshape(len(source), words),
                                target=target.view(np.uint32).reshape(m, words))
    return target


def prune(dev, arrays, indices):
    """Replace every array of the dict `arrays` by its rows `indices`, in place.

    One after the other, so that an old array nobody else holds is released before the next is copied.
    arrays: {name: (N, ...)} of 4-byte dtypes. indices: (M,) uint32.
    """
    for name in arrays:
        arrays[name] = gather_rows(dev, arrays[name], indices)
