"""Shared by the tests: guarded buffers, finite differences, real data."""

import os
import weakref
from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array

from pp_cl.device import Device

DATA = Path(os.environ.get("PP_DATA") or Path(__file__).parents[1] / ".." / "shared" / "data").resolve()

AWKWARD_SIZES = (1, 31, 33, 257)  # below, at and beside every vector width and work-group size
CANARY_BYTES = 256
CANARY = 0xA5


class GuardedDevice(Device):
    """A Device whose fresh buffers hold NaN (0xff bytes) and are followed by canary bytes that check() compares."""

    def __init__(self, device):
        super().__init__(device)
        self._guarded = []

    def _allocate(self, shape, dtype):
        dtype = np.dtype(dtype)
        nbytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        if nbytes == 0:
            return super()._allocate(shape, dtype)
        buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, nbytes + CANARY_BYTES)
        cl.enqueue_copy(self.queue, buffer, np.full(nbytes, 0xFF, np.uint8))
        cl.enqueue_copy(self.queue, buffer, np.full(CANARY_BYTES, CANARY, np.uint8), dst_offset=nbytes)
        array = cl_array.Array(self.queue, shape, dtype, data=buffer)
        self.bytes += nbytes
        self.peak_bytes = max(self.peak_bytes, self.bytes)
        weakref.finalize(array, self._released, nbytes)
        self._guarded.append((buffer, nbytes))
        return array

    def check(self):
        """Fail if a kernel wrote behind a buffer allocated since the last check, temporary ones included."""
        guarded, self._guarded = self._guarded, []
        tail = np.empty(CANARY_BYTES, np.uint8)
        for buffer, nbytes in guarded:
            cl.enqueue_copy(self.queue, tail, buffer, src_offset=nbytes)
            assert (tail == CANARY).all(), f"a kernel wrote behind a buffer of {nbytes} bytes"


def relative_error(actual, expected):
    """Largest absolute difference over the largest absolute expected value (both as float64)."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    assert actual.shape == expected.shape, (actual.shape, expected.shape)
    assert np.isfinite(actual).all(), "NaN or Inf in the result"
    return np.abs(actual - expected).max(initial=0) / max(np.abs(expected).max(initial=0), 1e-30)


def numeric_gradient(function, values, step, indices=None):
    """Central differences of a scalar function of a float64 array, at flat `indices` (all by default): (len(indices),)."""
    values = np.array(values, np.float64)
    indices = range(values.size) if indices is None else indices
    gradient = []
    for i in indices:
        upper, lower = values.copy(), values.copy()
        upper.flat[i] += step
        lower.flat[i] -= step
        gradient.append((function(upper) - function(lower)) / (2 * step))
    return np.array(gradient)
