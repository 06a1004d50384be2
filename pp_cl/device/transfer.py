"""Transfers that do not wait for the device: the host goes on, and asks for what it needs later."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from pp_cl.device.device import Device


class Reading:
    """A copy of a device array that is on its way to the host."""

    def __init__(self, event: cl.Event, values: np.ndarray):
        self._event, self._values = event, values

    def get(self) -> np.ndarray:
        """The values; waits until they are there."""
        if self._event is not None:
            self._event.wait()
            self._event = None
        return self._values


def read_later(dev: Device, array: Array, start: int = 0) -> Reading:
    """A copy of array[start:], (N,), as the kernels enqueued so far will leave it."""
    values = np.empty(len(array) - start, array.dtype)
    event = dev.attempt(
        "download a buffer",
        cl.enqueue_copy,
        dev.queue,
        values,
        array.base_data,
        src_offset=array.offset + start * array.dtype.itemsize,
        is_blocking=False,
    )
    return Reading(event, values)
