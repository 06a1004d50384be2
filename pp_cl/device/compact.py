"""Rows of an array: some moved to its front without a second array of its size, or gathered."""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.device.form import row_parts

# bytes of the scratch that rows are moved through: 1.4 % of a training with 4 million points
SCRATCH_BYTES = 2**27
CHANNELS = 16  # words of a row of features


def compact_table(n: int, row_bytes: int) -> Table:
    """What compacting arrays of n rows takes at most: the list of the rows that stay, and the
    scratch. row_bytes: of the array with the largest rows.
    """
    scratch = min(SCRATCH_BYTES, n * row_bytes)
    return {"keep": ((n,), np.uint32), "scratch": ((scratch,), np.uint8)}


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
        _gather(dev, array, keep, scratch, first=start, count=count)
        if piece < m:
            dev.copy_rows(array, start, scratch, count)
    return scratch if piece == m else array[:m]


def gather_rows(dev: Device, array: Array, rows: Array) -> Array:
    """A new array of the rows `rows` of `array`, (N, ...) of whole 4-byte words. rows: (M,) uint32,
    in any order, with repetitions.
    """
    gathered = dev.empty((len(rows), *array.shape[1:]), array.dtype)
    _gather(dev, array, rows, gathered, first=0, count=len(rows))
    return gathered


def _gather(dev, array, rows, target, *, first, count):
    """Copy the rows rows[first] to rows[first + count] of `array` to the front of `target`."""
    words = array.nbytes // len(array) // 4
    items = row_parts(dev) if words >= CHANNELS else 1
    dev.program("device/compact", GROUP=items).launch(
        "gather_rows",
        count * items,
        first=first,
        m=count,
        r=words,
        indices=rows,
        source=_words(array),
        target=_words(target),
    )


def _words(array):
    """The same memory as (rows, words) uint32."""
    return array.reshape(len(array), -1).view(np.uint32)
