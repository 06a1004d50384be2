"""Shared by the tests: guarded buffers, finite differences, real data."""

import os
import weakref
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from pyopencl.array import Array

from pp_cl.engine.device.device import Device, Fill, Memory

DATA = Path(
    os.environ.get("PP_DATA") or Path(__file__).parents[2] / ".." / "shared" / "data"
).resolve()

CANARY_BYTES = 256
CANARY = 0xA5
MOST_UNCHECKED = 2**28  # bytes of released buffers that wait for a check


def large(*values):
    """Arguments of a test that takes too long in a simulator (`make oclgrind`)."""
    return pytest.param(*values, marks=pytest.mark.large)


def slow(*values):
    """Arguments of a test that `make test-slow` runs; faster ones cover part of it."""
    return pytest.param(*values, marks=pytest.mark.slow)


class GuardedDevice(Device):
    """A Device whose fresh buffers hold NaN (0xff bytes) and are followed by canary bytes that
    check() compares. Before it replays a function's launches, it checks that the function would
    launch the same again.
    """

    canary_bytes, doubts = CANARY_BYTES, True

    def __init__(self, device):
        super().__init__(device)
        self._guarded, self._unchecked = [], 0
        self._is_dry = False

    def compare(self, launches, function):
        """Fail unless the function would launch and fill exactly what was recorded."""
        self._is_dry = True
        try:
            with self.recording() as again:
                function()
        finally:
            self._is_dry = False
        assert [*map(facts_of, launches)] == [*map(facts_of, again)]

    def enqueue(self, launch):
        """As Device.enqueue; within compare(), only record the launch."""
        if self._is_dry:
            self._recording.append(launch)
        else:
            super().enqueue(launch)

    def _fill(self, array, value):
        if not self._is_dry:
            super()._fill(array, value)

    def _memory(self, nbytes):
        if self._unchecked > MOST_UNCHECKED:
            self.check()
        poison = np.full(nbytes + self.canary_bytes, 0xFF, np.uint8)
        poison[nbytes:] = CANARY
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
        memory = Memory(self.context, flags, hostbuf=poison)
        # a second handle, as holding `memory` would delay its release in the device's count
        buffer = cl.Buffer.from_int_ptr(memory.int_ptr)
        self._guarded.append((weakref.ref(memory), buffer, nbytes))
        self._unchecked += nbytes
        return memory

    def scratch(self, name, n, dtype=np.float32, **options):
        """As Device.scratch, with exactly the memory that is asked for."""
        return super().scratch((name, n), n, dtype, **options)

    def check(self):
        """Fail if a kernel wrote past the end of a buffer, temporary ones included, that was in use
        since the last check.
        """
        self.finish()
        guarded, self._guarded, self._unchecked = self._guarded, [], 0
        tail = np.empty(CANARY_BYTES, np.uint8)
        for _, buffer, nbytes in guarded:
            cl.enqueue_copy(self.queue, tail, buffer, src_offset=nbytes)
            assert (tail == CANARY).all(), f"a kernel wrote behind a buffer of {nbytes} bytes"
        self._guarded = [entry for entry in guarded if entry[0]() is not None]


def facts_of(launch):
    """Facts that are equal for two launches or fills that do the same."""
    if isinstance(launch, Fill):
        return place_of(launch.array), launch.value
    values = {name: place_of(value) for name, value in launch.arguments.items()}
    return launch.kernel.label, launch.size, launch.local, launch.offset, values


def place_of(value):
    """An array's address, shape and dtype; any other value is returned."""
    is_array = isinstance(value, Array)
    return (value.base_data, value.offset, value.shape, value.dtype) if is_array else value


class TracedDevice(GuardedDevice):
    """The guarded device for Oclgrind 21.10's search for reads of uninitialised memory; a report
    fails the test.

    Oclgrind tracks writes by kernels and whole uploads, not by fills and copies, and takes memory
    at a freed buffer's address for initialised: here kernels fill and copy, and no buffer is freed.
    It finds writes out of bounds without canaries.
    """

    canary_bytes = 0
    SOURCE = """
    kernel void fill(global uchar *target, global const uchar *value, const uint size) {
        target[get_global_id(0)] = value[get_global_id(0) % size];
    }
    kernel void copy(global uchar *target, const uint start, global const uchar *source) {
        target[start + get_global_id(0)] = source[get_global_id(0)];
    }
    """

    def __init__(self, device, log):
        super().__init__(device)
        self._log, self._reported = log, 0
        program = cl.Program(self.context, self.SOURCE).build()
        self._fill_kernel, self._copy_kernel = program.fill, program.copy

    def _fill(self, array, value):
        if array.size and not self._is_dry:
            value = self.upload(np.full(1, value, array.dtype))
            self._fill_kernel(
                self.queue, (array.nbytes,), None, array.data, value.data, np.uint32(value.nbytes)
            )

    def copy(self, target, source, start=0):
        """As Device.copy."""
        row_bytes = source[:1].nbytes
        if source.size:
            self._copy_kernel(
                self.queue,
                (source.nbytes,),
                None,
                target.data,
                np.uint32(start * row_bytes),
                source.data,
            )

    def check(self):
        """Fail if Oclgrind has reported anything since the last check. Buffers stay in _guarded,
        so that none is freed.
        """
        reports, self._unchecked = self._log.read_text(), 0
        new, self._reported = reports[self._reported :], len(reports)
        assert not new, new[:2000]
