"""Asynchronous downloads: the host goes on, and waits only when it asks for the values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from pp_cl.device.device import Device

T = TypeVar("T")


class Reading(Generic[T]):
    """A value that the host gets from a download under way.

    values: the target of the download, filled at the event. convert: makes the value of them.
    """

    def __init__(self, event: cl.Event, values: np.ndarray, convert: Callable[[np.ndarray], T]):
        self._event, self._values, self._convert = event, values, convert

    def get(self) -> T:
        """The value; waits for the download."""
        if self._event is not None:
            self._event.wait()
            self._values = self._convert(self._values)
            self._event = None
        return self._values


def read_later(
    dev: Device,
    array: Array,
    start: int = 0,
    convert: Callable[[np.ndarray], Any] = lambda values: values,
) -> Reading:
    """array[start:], (N,), as the kernels enqueued so far will leave it. convert: applied once to
    the numpy array, when it is asked for; what it raises, get() raises.
    """
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
    return Reading(event, values, convert)
