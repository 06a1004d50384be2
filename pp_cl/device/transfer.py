"""Transfers that do not wait for the device: the host goes on, and asks for what it needs later."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from pp_cl.device.buffers import scratch
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


def send_all(dev: Device, name: Hashable, values: Sequence[np.ndarray]) -> list[Array]:
    """Copies of several numpy arrays on the device by one transfer that is not waited for: parts of
    one buffer, valid until the next call with this name.
    """
    align = dev.device.mem_base_addr_align // 8
    ends = np.cumsum([0, *(-(-max(v.nbytes, 1) // align) * align for v in values)])
    packed = np.zeros(ends[-1], np.uint8)
    whole, parts = scratch(dev, name, len(packed), np.uint8), []
    for start, array in zip(ends, values, strict=False):
        packed[start : start + array.nbytes] = np.ascontiguousarray(array).reshape(-1).view("u1")
        region = whole.base_data.get_sub_region(int(start), max(array.nbytes, 1))
        parts.append(Array(dev.queue, array.shape, array.dtype, data=region))
    send(dev, whole, packed)
    return parts


def _is_complete(event):
    return event.command_execution_status == cl.command_execution_status.COMPLETE
