"""Groups of device arrays, declared as a table {name: (shape, dtype)} or packed into one buffer;
downloads that do not wait; and functions that gather, keep or read rows piecewise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from pp_cl.engine.device.device import Device, QueuedArray
from pp_cl.engine.device.launch import row_parts

# bytes of scratch memory for moving rows: 1.4 % of a training's with 4 million points
SCRATCH_BYTES = 2**27
PIECE_BYTES = 2**26  # read by the host at a time
CHANNELS = 16  # words of a row of features

T = TypeVar("T")
Row = tuple[tuple[int, ...], Any]  # (shape, dtype)
Table = dict[str, Row]


def table_bytes(table: Table) -> int:
    """Bytes of all arrays of a table."""
    return sum(_row_bytes(*row) for row in table.values())


def _row_bytes(shape, dtype):
    return math.prod(shape) * np.dtype(dtype).itemsize


def grown(capacity: int, needed: int) -> int:
    """The capacity if it holds `needed`, otherwise a quarter more than `needed`."""
    return capacity if needed <= capacity else needed + needed // 4


class Buffers:
    """The device arrays of one stage, as attributes named like the rows of its table.

    An array whose shape and dtype stay the same keeps its memory and its content. calls: recorded
    calls of replayed() functions.
    """

    def __init__(self, dev: Device):
        self.dev = dev
        self.calls: dict[Any, Any] = {}
        self._arrays: dict[str, Array] = {}

    def require(self, table: Table) -> None:
        """Allocate the arrays of the table that are missing or have another shape or dtype,
        uninitialised.

        Old arrays are released before new ones are allocated. Raises UserError if memory does not
        suffice.
        """
        changed = [name for name, row in table.items() if not self._fits(name, *row)]
        if changed:
            self.calls.clear()
        for name in changed:
            self._arrays.pop(name, None)
        for name in changed:
            self._arrays[name] = self.dev.empty(*table[name])

    def _fits(self, name, shape, dtype):
        array = self._arrays.get(name)
        return array is not None and array.shape == tuple(shape) and array.dtype == dtype

    def __getattr__(self, name: str) -> Array:
        try:
            return self._arrays[name]
        except KeyError:
            raise AttributeError(f"no buffer {name!r} was required yet") from None


def packed_arrays(dev: Device, rows: Sequence[Row]) -> tuple[Array, list[Array]]:
    """(octets, arrays of these shapes and dtypes within their memory), all zeros: one launch or
    transfer handles them all. The arrays are valid only while the octets are referenced.
    """
    align = dev.device.mem_base_addr_align // 8
    sizes = [-(-max(1, _row_bytes(*row)) // align) * align for row in rows]
    starts = [0, *map(int, np.cumsum(sizes))]
    whole = dev.zeros((starts.pop(),), np.uint8)
    data: Any = whole.base_data
    arrays: list[Array] = []
    for start, (shape, dtype) in zip(starts, rows, strict=True):
        region = data.get_sub_region(start, max(1, _row_bytes(shape, dtype)))
        arrays.append(QueuedArray(dev.queue, shape, dtype, data=region))
    return whole, arrays


class PackedArrays:
    """Device arrays in one buffer, which one transfer overwrites."""

    def __init__(self, dev: Device):
        self._dev = dev
        self._rows: list[Row] = []
        self._arrays: list[Array] = []
        self._whole: Any = None

    def send(self, rows: list[Row], values: Sequence[np.ndarray]) -> list[Array]:
        """Arrays of these shapes and dtypes, overwritten by `values` after all work enqueued so
        far; they keep their memory if `rows` is the same as before. values: of these dtypes; if one
        is shorter than its array, the rest of the array is undefined.
        """
        if rows != self._rows:
            self._rows, self._whole, self._arrays = [], None, []  # frees the old ones first
            self._whole, self._arrays = packed_arrays(self._dev, rows)
            self._rows = rows
        packed = np.empty(self._whole.shape, np.uint8)
        for array, value in zip(self._arrays, values, strict=True):
            octets = np.ascontiguousarray(value).reshape(-1).view(np.uint8)
            data: Any = array.base_data
            packed[data.offset : data.offset + value.nbytes] = octets
        self._dev.send(self._whole, packed)
        return self._arrays


class Pending(Generic[T]):
    """A value that the host gets from a download in progress.

    values: the target of the download, filled when the event completes. convert: computes the value
    from them.
    """

    def __init__(
        self,
        dev: Device,
        event: cl.Event,
        values: np.ndarray,
        convert: Callable[[np.ndarray], T],
    ):
        self._dev = dev
        self._event: cl.Event | None = event
        self._values: Any = values
        self._convert = convert

    def get(self) -> T:
        """The value; waits for the download. Raises UserError as Device.attempt() does."""
        if self._event is not None:
            self._dev.wait(self._event.wait)
            self._values = self._convert(self._values)
            self._event = None
        return self._values


def read_later(
    dev: Device,
    array: Array,
    start: int = 0,
    convert: Callable[[np.ndarray], Any] = lambda values: values,
) -> Pending:
    """array[start:], as the kernels enqueued so far will leave it. convert: applied to the numpy
    array by the first get(), which passes on its exceptions.
    """
    values = np.empty((len(array) - start, *array.shape[1:]), array.dtype)
    event = dev.attempt(
        "download a buffer",
        cl.enqueue_copy,
        dev.queue,
        values,
        array.base_data,
        src_offset=array.offset + start * array.strides[0],
        is_blocking=False,
    )
    return Pending(dev, event, values, convert)


# ---- rows; only gather_rows() takes a second array of a model's size, which may not fit


def compact_rows(dev: Device, array: Array, keep: Array) -> Array:
    """The rows `keep` of `array`; the content of `array` is lost.

    If the rows fit SCRATCH_BYTES, they become a new array. Otherwise they move to the front of the
    same buffer, piece by piece: as indices ascend, no row moves to a higher place, so no piece
    overwrites rows that a later piece reads. array: (N, ...), rows of whole 4-byte words. keep:
    (M,) uint32, ascending.
    """
    m, row_bytes = len(keep), array.nbytes // len(array)
    piece = min(m, max(1, SCRATCH_BYTES // row_bytes))
    scratch = dev.empty((piece, *array.shape[1:]), array.dtype)
    for start in range(0, m, piece):
        count = min(piece, m - start)
        _gather(dev, array, keep, scratch, first=start, count=count)
        if piece < m:
            dev.copy(array, scratch[:count], start)
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
    """Arrays (N, ...) of a device, joined along their second axis. They are downloaded on request
    and must not change before. shape, dtype: of the joined array.
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
