"""Transfers that do not wait for the device: the host goes on, and asks for what it needs later."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from pp_cl.device.device import Device

T = TypeVar("T")


class Reading(Generic[T]):
    """Something that the host knows once numbers have come from the device.

    values: on their way until the event. convert: what they mean.
    """

    def __init__(self, event: cl.Event, values: np.ndarray, convert: Callable[[np.ndarray], T]):
        self._event, self._values, self._convert = event, values, convert

    def get(self) -> T:
        """What the numbers mean; waits until they are there."""
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
