"""Transfers that do not wait for the device: the host goes on, and asks for what it needs later."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
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


def send(dev: Device, array: Array, values: np.ndarray) -> None:
    """Overwrite an array of the device, after what is enqueued, by a numpy array of its shape and
    dtype, which must not change any more. Raises ValueError for another shape or dtype.
    """
    if values.shape != array.shape or values.dtype != array.dtype:
        raise ValueError(f"send: {values.shape} {values.dtype} to {array.shape} {array.dtype}")
    event = dev.attempt(
        "upload a buffer",
        cl.enqueue_copy,
        dev.queue,
        array.base_data,
        np.ascontiguousarray(values),
        dst_offset=array.offset,
        is_blocking=False,
    )
    # an event that is dropped waits for the end of its transfer
    dev.sent.append(event)
    while _is_complete(dev.sent[0]) and len(dev.sent) > 1:
        dev.sent.popleft()


class Parts:
    """Several arrays of a device in one buffer, which one transfer overwrites.

    forms: [(shape, dtype)] of the arrays.
    """

    def __init__(self, dev: Device, forms: Sequence[tuple[tuple[int, ...], type]]):
        self._dev, self.forms = dev, forms
        align = dev.device.mem_base_addr_align // 8
        sizes = [max(1, math.prod(shape) * np.dtype(dtype).itemsize) for shape, dtype in forms]
        self._starts = np.cumsum([0, *(-(-size // align) * align for size in sizes)])
        self._whole = dev.empty((int(self._starts[-1]),), np.uint8)
        self.arrays = []
        for (shape, dtype), start, size in zip(forms, self._starts, sizes, strict=False):
            region = self._whole.base_data.get_sub_region(int(start), size)
            self.arrays.append(Array(dev.queue, shape, dtype, data=region))

    def send(self, values: Sequence[np.ndarray]) -> None:
        """Overwrite the arrays, after what is enqueued, by these of their dtypes; what is behind
        shorter ones is undefined.
        """
        packed = np.empty(self._whole.shape, np.uint8)
        for start, value in zip(self._starts, values, strict=False):
            packed[start : start + value.nbytes] = (
                np.ascontiguousarray(value).reshape(-1).view("u1")
            )
        send(self._dev, self._whole, packed)


def shared_parts(
    dev: Device, name: Hashable, forms: Sequence[tuple[tuple[int, ...], type]]
) -> Parts:
    """Parts of these forms, the same ones as long as calls with this name ask for the same."""
    held = dev.scratch.get(name)
    if held is None or held.forms != forms:
        dev.scratch[name] = None  # frees the old ones first
        held = dev.scratch[name] = Parts(dev, forms)
    return held


def _is_complete(event):
    return event.command_execution_status == cl.command_execution_status.COMPLETE
