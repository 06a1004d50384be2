"""Device arrays declared as a table, {name: (shape, dtype)}: what a stage allocates and what the
memory plan counts.
"""

from __future__ import annotations

import math
from collections.abc import Hashable

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device

Table = dict[str, tuple[tuple[int, ...], type]]


def table_bytes(table: Table) -> int:
    """Bytes of all arrays of a table."""
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in table.values())


def grown(capacity: int, needed: int) -> int:
    """The capacity, or a quarter more than `needed` where that is more than it holds."""
    return capacity if needed <= capacity else needed + needed // 4


def scratch(dev: Device, name: Hashable, n: int, dtype: type) -> Array:
    """(n,) uninitialised, in memory that all calls with this name share: only for what kernels
    enqueued before the next such call read.
    """
    held = dev.scratch.get(name)
    if held is None or len(held) < n or held.dtype != dtype:
        held = dev.scratch[name] = None  # frees the old one first
        held = dev.scratch[name] = dev.empty((grown(0, n),), dtype)
    return held[:n]


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
