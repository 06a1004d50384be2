"""Dropping points that contribute nothing, with everything that is stored per point."""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device

# bytes of the scratch that rows are moved through: 1.4 % of a training with 4 million points
SCRATCH_BYTES = 2**27


def prune_table(n: int, row_bytes: int) -> Table:
    """What pruning takes at most: the list of the points kept, and the scratch. row_bytes: of the
    largest array of a point.
    """
    scratch = min(SCRATCH_BYTES, n * row_bytes)
    return {"keep": ((n,), np.uint32), "scratch": ((scratch,), np.uint8)}


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


def compact_rows(dev: Device, array: Array, keep: Array) -> Array:
    """The rows `keep` of `array`, which is overwritten, without a second array of its size.

    Rows that fit SCRATCH_BYTES become an array of their own. Others move to the front of the same
    buffer, piece by piece: ascending indices never lie before their new place, so a piece
    overwrites nothing that a later one reads. array: (N, ...), rows of whole 4-byte words. keep:
    (M,) uint32, ascending.
    """
    m, row_bytes = len(keep), array.nbytes // len(array)
    piece = min(m, max(1, SCRATCH_BYTES // row_bytes))
    scratch = dev.empty((piece, *array.shape[1:]), array.dtype)
    for start in range(0, m, piece):
        count = min(piece, m - start)
        dev.program("training/prune").launch(
            "gather_rows",
            count,
            first=start,
            m=count,
            r=row_bytes // 4,
            indices=keep,
            source=_words(array),
            target=_words(scratch),
        )
        if piece < m:
            dev.copy_rows(array, start, scratch, count)
    return scratch if piece == m else dev.front(array, m)


def _words(array):
    """The same memory as (rows, words) uint32."""
    return array.reshape(len(array), -1).view(np.uint32)
