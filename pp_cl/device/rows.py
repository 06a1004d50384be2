"""Rows of device arrays: gathered by index, compacted after pruning, and downloaded in pieces.

None of it takes a second array of a model's size, which may not fit into memory.
"""

from collections.abc import Iterator

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.device.launch import row_parts

# bytes of the scratch that rows are moved through: 1.4 % of a training with 4 million points
SCRATCH_BYTES = 2**27
PIECE_BYTES = 2**26  # that the host reads at a time
CHANNELS = 16  # words of a row of features


def compact_table(n: int, row_bytes: int) -> Table:
    """What compact_rows() of arrays of n rows takes at most: the list of the rows that stay, and
    the scratch. row_bytes: of the array with the largest rows.
    """
    scratch = min(SCRATCH_BYTES, n * row_bytes)
    return {"keep": ((n,), np.uint32), "scratch": ((scratch,), np.uint8)}


def compact_rows(dev: Device, array: Array, keep: Array) -> Array:
    """The rows `keep` of `array`; the content of `array` is lost.

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
    dev.program("device/rows", GROUP=items).launch(
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


class DeviceRows:
    """Arrays (N, ...) of a device side by side, joined along their second axis. Fetched when asked
    for: they must not change before. shape, dtype: of the joined array.
    """

    def __init__(self, dev: Device, *parts: Array) -> None:
        self._dev, self._parts = dev, parts
        first = parts[0]
        joined = (sum(part.shape[1] for part in parts),) if len(parts) > 1 else first.shape[1:2]
        self.shape = (*first.shape[:1], *joined, *first.shape[2:])
        self.dtype = first.dtype

    @property
    def nbytes(self) -> int:
        """Bytes of the joined array."""
        return sum(part.nbytes for part in self._parts)

    def pieces(self) -> Iterator[np.ndarray]:
        """The rows in numpy arrays of at most PIECE_BYTES, or of one row."""
        count = self.shape[0]
        rows = max(1, PIECE_BYTES * count // max(1, self.nbytes))
        for start in range(0, count, rows):
            columns = [self._dev.download(part[start : start + rows]) for part in self._parts]
            yield np.concatenate(columns, 1) if len(columns) > 1 else columns[0]

    def get(self) -> np.ndarray:
        """The joined array."""
        return np.concatenate([*self.pieces()] or [np.empty(self.shape, self.dtype)])
