"""The buffers of a stage, declared as a table {name: (shape, dtype)} from which they are allocated
and the memory plan is summed; and arrays packed into one buffer for one transfer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device

Table = dict[str, tuple[tuple[int, ...], type]]


def table_bytes(table: Table) -> int:
    """Bytes of all arrays of a table."""
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in table.values())


def grown(capacity: int, needed: int) -> int:
    """The capacity if it holds `needed`, else a quarter more than `needed`."""
    return capacity if needed <= capacity else needed + needed // 4


class Buffers:
    """The device arrays of one stage, as attributes named like the rows of its table.

    An array whose shape and dtype stay the same keeps its memory and its content.
    """

    def __init__(self, dev: Device):
        self._dev = dev
        self._arrays: dict[str, Array] = {}

    def require(self, table: Table) -> None:
        """Allocate the arrays of the table that are missing or have another shape or dtype,
        uninitialised.

        Old arrays are released before new ones are allocated. Raises UserError where memory does
        not suffice.
        """
        changed = [name for name, row in table.items() if not self._fits(name, *row)]
        for name in changed:
            self._arrays.pop(name, None)
        for name in changed:
            self._arrays[name] = self._dev.empty(*table[name])

    def _fits(self, name, shape, dtype):
        array = self._arrays.get(name)
        return array is not None and array.shape == tuple(shape) and array.dtype == dtype

    def __getattr__(self, name: str) -> Array:
        try:
            return self._arrays[name]
        except KeyError:
            raise AttributeError(f"no buffer {name!r} was required yet") from None


class PackedArrays:
    """Device arrays in one buffer, which one transfer overwrites."""

    def __init__(self, dev: Device):
        self._dev = dev
        self._rows: list[tuple[tuple[int, ...], type]] = []
        self._starts, self._whole, self._arrays = [], None, []

    def send(
        self, rows: list[tuple[tuple[int, ...], type]], values: Sequence[np.ndarray]
    ) -> list[Array]:
        """Arrays of these shapes and dtypes, in the same memory as those before if these were the
        same, overwritten after what is enqueued. values: of these dtypes; what is behind shorter
        ones is undefined.
        """
        if rows != self._rows:
            self._allocate(rows)
        packed = np.empty(self._whole.shape, np.uint8)
        for start, value in zip(self._starts, values, strict=True):
            octets = np.ascontiguousarray(value).reshape(-1).view(np.uint8)
            packed[start : start + value.nbytes] = octets
        self._dev.send(self._whole, packed)
        return self._arrays

    def _allocate(self, rows):
        self._rows, self._whole, self._arrays = rows, None, []  # frees the old ones first
        align = self._dev.device.mem_base_addr_align // 8
        sizes = [max(1, math.prod(shape) * np.dtype(dtype).itemsize) for shape, dtype in rows]
        *self._starts, end = np.cumsum([0, *(-(-size // align) * align for size in sizes)])
        self._whole = self._dev.empty((int(end),), np.uint8)
        for (shape, dtype), start, size in zip(rows, self._starts, sizes, strict=True):
            region = self._whole.base_data.get_sub_region(int(start), size)
            self._arrays.append(Array(self._dev.queue, shape, dtype, data=region))
