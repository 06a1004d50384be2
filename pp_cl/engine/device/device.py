"""An OpenCL device: builds programs, launches kernels, allocates and copies buffers."""

from __future__ import annotations

import atexit
import math
import sys
import time
import weakref
from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike, DTypeLike
from pyopencl.array import Array

from pp_cl.engine.device.host import ask_for_huge_pages
from pp_cl.engine.device.kernel import Kernel, cut, quiet_compiler
from pp_cl.engine.device.observe import check_outputs, debug_level, print_times
from pp_cl.engine.device.quirks import (
    acts_as_cpu,
    describe,
    has_watchdog,
    ignore_full_files,
    vendor_options,
)
from pp_cl.engine.device.signature import parse_signatures
from pp_cl.errors import BuildError, UserError

SMALLER = "lower --points or raise --downscale"
HUGE = 2**22  # bytes from which on a buffer gets pages of 2 MiB
# Systems reset a GPU that draws the screen when one kernel takes about 2 seconds. This many
# multiply-adds take half a second at 100 GFLOP/s; see docs/devices.md.
MOST_MULTIPLY_ADDS = 25e9
UNTIMED = nullcontext()  # a stage without timing
STANDARD = ("-cl-std=CL1.2",)  # options of every build


def kernel_folder() -> Path:
    """The folder of the .cl files: inside the installed package, or next to it in a checkout."""
    inside = Path(__file__).parents[2] / "cl"
    return inside if inside.is_dir() else Path(__file__).parents[3] / "cl"


def _released(device, nbytes):
    """Subtract freed memory from the device's total. device: a weak reference."""
    alive = device()
    if alive is not None:
        alive.bytes -= nbytes


class Memory(cl.Buffer):
    """A cl.Buffer that takes weak references, so that its release can be counted."""


class QueuedArray(Array):
    """An Array that keeps no events, as its queue works in order: the events of its transfers would
    keep alive the last dozen numpy arrays that it was copied to.
    """

    def add_event(self, evt: cl.Event) -> None:
        """Do nothing."""


class Launch(NamedTuple):
    """A launch that has been checked. offset: of its first work-item, or None. values: arguments in
    the kernel's order; arguments: the same by name. watched: it may take too long for a watchdog.
    own: a kernel object that keeps these arguments, or None.
    """

    kernel: Kernel
    size: tuple[int, ...]
    local: tuple[int, ...]
    offset: tuple[int, ...] | None
    values: list[Any]
    arguments: dict[str, Any]
    watched: bool
    own: cl.Kernel | None = None


class Fill(NamedTuple):
    """A fill: all elements of the array are set to the value."""

    array: Array
    value: float


class Device:
    """One OpenCL device with its queue, programs and buffers. debug: value of PP_DEBUG
    (docs/devices.md). is_cpu: drivers and kernels work as they do on CPUs. has_watchdog: long
    kernels are launched in parts. launches: number so far. waited: CPU seconds of threads that
    waited for the device; CPU drivers let them compute meanwhile. doubts: call compare(), which
    only the tests' device has, before each replay().
    """

    doubts = False

    def __init__(self, device: cl.Device):
        self.device = device
        self.name = device.name.strip()
        self.info = describe(device)
        self.is_cpu = acts_as_cpu(device)
        self.has_watchdog = not self.is_cpu and has_watchdog(device)
        self.debug = debug_level()
        self.context = cl.Context([device])
        profiling: Any = cl.command_queue_properties.PROFILING_ENABLE if self.debug else 0
        self.queue = cl.CommandQueue(self.context, properties=profiling)
        ignore_full_files()
        self._maps = cl.CommandQueue(self.context)  # its maps do not wait for kernels
        self.bytes = self.peak_bytes = self.launches = 0
        self.waited = 0.0
        self._recording: list[Any] | None = None
        self._sent: deque[Any] = deque()  # events of send()
        self._scratch: dict[Hashable, Any] = {}  # {name: array} of scratch()
        self.scratch_version = 0  # changes when scratch() allocates
        self._programs: dict[Any, Program] = {}
        self._constants: dict[Any, Any] = {}
        self._seconds: dict[str, list[float]] = defaultdict(list)
        self._stage_seconds: dict[str, list[float]] | None = None
        if self.debug:
            self._stage_seconds = defaultdict(list)
            atexit.register(self.print_profile)

    @property
    def build_options(self) -> list[str]:
        """Options of every build; each program adds its folder and macros."""
        # PoCL writes the number of clang's warnings to the terminal: dozens without AVX-512, all
        # about how a float16 is passed
        return [*STANDARD, *([] if self.debug else ["-w"])]

    def program(self, name: str, **defines: int | float | str) -> Program:
        """The Program of cl/<name>.cl built with -D for each define; built once.

        Raises BuildError with the file, the options and the compiler's output if the build fails.
        """
        key = name, frozenset(defines.items())
        if key not in self._programs:
            self._programs[key] = self._built(name, defines)
        return self._programs[key]

    def _built(self, name, defines):
        folder = kernel_folder()
        if " " in str(folder):  # PoCL 3.1 splits its options at spaces, quoted or not
            raise UserError(
                f"{folder}: OpenCL compilers cannot include from a folder with a space in its"
                " path; move it"
            )
        macros = [f"-D{k}={v}" for k, v in sorted(defines.items())]
        start = time.perf_counter()
        program = Program(
            self,
            name,
            (folder / f"{name}.cl").read_text("utf-8"),
            options=[
                *self.build_options,
                *vendor_options(self.info, name),
                "-I",
                folder.as_posix(),
                *macros,
            ],
            defines=defines,
        )
        if self.debug:
            seconds = time.perf_counter() - start
            print(
                f"cl/{name}.cl {' '.join(macros)} built in {seconds:.2f} s",
                file=sys.stderr,
            )
        return program

    def empty(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float32) -> Array:
        """Uninitialised array on the device; zeros under PP_DEBUG=3, so that its scan sees only
        values that kernels wrote.
        """
        array = self._allocate(shape, dtype)
        if self.debug >= 3 and array.nbytes:
            self._fill(array, 0)
        return array

    def scratch(self, name: Hashable, n: int, dtype: type = np.float32, *, zeros: int = 0) -> Array:
        """Uninitialised array, (n,) or longer, in memory that all calls with this name share: valid
        only for kernels enqueued before the next such call. zeros: number of values at the front
        set to 0 on allocation, for kernels that leave zeros there.
        """
        held = self._scratch.get(name)
        if held is None or len(held) < n or held.dtype != dtype:
            self.scratch_version += 1
            held = self._scratch[name] = None  # frees the old one first
            held = self._scratch[name] = self.empty((n,), dtype)
            if zeros:
                self._fill(held[:zeros], 0)
        return held

    def constant(self, rows: Sequence[tuple[int, ...]]) -> Array:
        """The rows as an int32 array on the device, uploaded only once."""
        key = tuple(rows)
        if key not in self._constants:
            self._constants[key] = self.upload(key, np.int32)
        return self._constants[key]

    def zeros(self, shape: int | tuple[int, ...], dtype: type = np.float32) -> Array:
        """Array of zeros on the device."""
        array = self._allocate(shape, dtype)
        self._fill(array, 0)
        return array

    def upload(self, values: ArrayLike, dtype: type | None = None) -> Array:
        """Copy of a numpy array on the device."""
        values = np.ascontiguousarray(values, dtype)
        array = self._allocate(values.shape, values.dtype)
        self.write(array, values)
        return array

    def write(self, array: Array, values: np.ndarray) -> None:
        """Overwrite an array of this device by a numpy array of its shape and dtype."""
        if array.size:
            self._upload(array, values, is_blocking=True)

    def send(self, array: Array, values: np.ndarray) -> None:
        """Overwrite an array after all work enqueued so far, without waiting for it; `values` must
        not change afterwards.
        """
        self._sent.append(self._upload(array, values, is_blocking=False))
        # dropping an event waits for the end of its transfer
        complete = cl.command_execution_status.COMPLETE
        while len(self._sent) > 1 and self._sent[0].command_execution_status == complete:
            self._sent.popleft()

    def _upload(self, array, values, *, is_blocking):
        if values.shape != array.shape or values.dtype != array.dtype:
            raise ValueError(f"write: {values.shape} {values.dtype} to {array.shape} {array.dtype}")
        values = np.ascontiguousarray(values)
        place = {"dst_offset": array.offset, "is_blocking": is_blocking}
        return self._copy("upload a buffer", array.base_data, values, **place)

    def download(self, array: Array) -> np.ndarray:
        """Copy of an array of this device."""
        values = np.empty(array.shape, array.dtype)
        if array.size:
            self._copy("download a buffer", values, array.base_data, src_offset=array.offset)
        return values

    def fill(self, array: Array, value: float) -> None:
        """Set all elements of an array of this device to one value."""
        if self._recording is not None:
            self._recording.append(Fill(array, value))
        self._fill(array, value)

    def _fill(self, array, value):
        if array.size:
            self.attempt(
                "fill a buffer",
                cl.enqueue_fill_buffer,
                self.queue,
                array.data,
                array.dtype.type(value),
                0,
                array.nbytes,
            )

    def copy(self, target: Array, source: Array, start: int = 0) -> None:
        """Copy one array of this device over the rows of another from row `start` on. Raises
        ValueError if its rows differ in size or dtype, or are too many.
        """
        row_bytes, count = source[:1].nbytes, len(source)
        is_alike = (target[:1].nbytes, target.dtype) == (row_bytes, source.dtype)
        if not is_alike or start + count > len(target):
            raise ValueError(
                f"copy: {source.shape} {source.dtype} into {target.shape} {target.dtype}"
            )
        if count:
            size = {"byte_count": count * row_bytes, "dst_offset": start * row_bytes}
            self._copy("copy a buffer", target.data, source.data, **size)

    def _copy(self, what, target, source, **place):
        return self.attempt(what, cl.enqueue_copy, self.queue, target, source, **place)

    def finish(self) -> None:
        """Wait until everything enqueued is done."""
        self.wait(self.queue.finish)

    def wait(self, function: Callable[[], Any]) -> None:
        """Call a driver function that waits. Raises UserError as attempt() does: GPU drivers often
        fail here for lack of memory.
        """
        start = time.thread_time()
        self.attempt("finish its work", function)
        self.waited += time.thread_time() - start

    def enqueue(self, launch: Launch) -> None:
        """Enqueue a checked launch. Raises UserError as attempt() does."""
        kernel = launch.kernel
        event = self.attempt(
            kernel.run,
            cl.enqueue_nd_range_kernel,
            self.queue,
            launch.own or kernel.with_arguments(launch.values),
            launch.size,
            launch.local,
            launch.offset,
        )
        self.launches += 1
        if self._recording is not None:
            self._recording.append(launch)
        if launch.watched:  # systems time together what drivers submit together
            self.queue.flush()
        if self.debug:
            self.observe(kernel, event, launch.arguments)

    @contextmanager
    def recording(self) -> Iterator[list[Any]]:
        """Yields a list to which each Launch and Fill inside the block is added."""
        launches: list[Any] = []
        self._recording = launches
        try:
            yield launches
        finally:
            self._recording = None

    def replay(self, launches: list[Any]) -> None:
        """Enqueue recorded launches and fills again; each launch gets its own kernel object, which
        keeps its arguments.
        """
        for i, launch in enumerate(launches):
            if isinstance(launch, Fill):
                self._fill(*launch)
                continue
            if launch.own is None:  # not when recorded: many calls are never repeated
                own = launch.kernel.with_arguments(launch.values, for_good=True)
                launch = launches[i] = launch._replace(own=own)
            self.enqueue(launch)

    def attempt(self, what: str, function: Callable[..., Any], *args, **kwargs) -> Any:
        """Call function(*args, **kwargs). Raises UserError if the driver fails for lack of memory,
        which many drivers allocate only at a buffer's first use, or with OUT_OF_RESOURCES, which
        NVIDIA's also reports for kernels that fault or run too long.
        """
        try:
            return function(*args, **kwargs)
        except (cl.MemoryError, cl.RuntimeError) as error:
            unsaid = "OUT_OF_RESOURCES" in str(error)
            why = " for want of memory, or since the driver ended a kernel" if unsaid else ""
            raise UserError(
                f"{self.name} cannot {what}{why} ({error}; {self.bytes / 2**20:.0f} MiB in use):"
                f" {SMALLER}, or choose another device (`pp-cl devices`)"
                f"{'; the log of the system may say more' if unsaid else ''}"
            ) from error

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Time the block as the stage `name` under PP_DEBUG >= 1 or in timed_stages().

        When timed, the queue is drained before and after, so that stages do not overlap.
        """
        return UNTIMED if self._stage_seconds is None else self._timed(name, self._stage_seconds)

    @contextmanager
    def _timed(self, name, seconds):
        self.finish()
        start = time.perf_counter()
        yield
        self.finish()
        seconds[name].append(time.perf_counter() - start)

    @contextmanager
    def timed_stages(self) -> Iterator[dict[str, list[float]]]:
        """Yields {stage name: [seconds of each pass]}, filled by the stages inside the block."""
        before, self._stage_seconds = self._stage_seconds, defaultdict(list)
        try:
            yield self._stage_seconds
        finally:
            self._stage_seconds = before

    def reset_peak(self) -> int:
        """Measure peak_bytes anew from here on. Returns the bytes in use."""
        self.peak_bytes = self.bytes
        return self.bytes

    def _allocate(self, shape, dtype):
        dtype = np.dtype(dtype)
        nbytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        largest, total = self.info["max_allocation_bytes"], self.info["memory_bytes"]
        if nbytes > largest or self.bytes + nbytes > total:
            raise UserError(
                f"a buffer of shape {tuple(np.atleast_1d(shape).tolist())} needs"
                f" {nbytes / 2**30:.2f} GiB; {self.name} allocates at most {largest / 2**30:.2f}"
                f" GiB at once and {total / 2**30:.2f} GiB in all, {self.bytes / 2**30:.2f} GiB are"
                f" in use: {SMALLER}"
            )
        what = f"allocate {nbytes / 2**20:.0f} MiB"
        return self.attempt(what, QueuedArray, self.queue, shape, dtype, allocator=self._counted)

    def _counted(self, nbytes):
        """Memory that is counted until the last array, slice or view of it is gone."""
        memory = self._memory(nbytes)
        self.bytes += nbytes
        self.peak_bytes = max(self.peak_bytes, self.bytes)
        # weakly: otherwise scratch memory and its device would keep each other alive
        weakref.finalize(memory, _released, weakref.ref(self), nbytes)
        return memory

    def _memory(self, nbytes):
        memory = Memory(self.context, cl.mem_flags.READ_WRITE, nbytes)
        if self.is_cpu and nbytes >= HUGE:  # host memory: a map gives its address
            flags = cl.map_flags.WRITE_INVALIDATE_REGION
            place = 0, (nbytes,), np.uint8
            mapped, _ = cl.enqueue_map_buffer(self._maps, memory, flags, *place)
            ask_for_huge_pages(mapped.ctypes.data, nbytes)
            mapped.base.release(self._maps)
            self._maps.finish()  # other queues use the memory next
        return memory

    def observe(self, kernel: Kernel, event: cl.Event, arguments: dict[str, Any]) -> None:
        """Wait for a kernel and record its time. PP_DEBUG 3: also stop at the first NaN or Inf in
        an output.
        """
        event.wait()
        self._seconds[kernel.label].append((event.profile.end - event.profile.start) * 1e-9)
        if self.debug >= 3:
            check_outputs(kernel, arguments)

    def print_profile(self) -> None:
        """Print a table to stderr, longest first: passes, median and total time of stages and of
        kernels; with PP_DEBUG 1 of kernel files instead of kernels.
        """
        print_times(self._stage_seconds or {}, self._seconds, by_file=self.debug < 2)


class Program:
    """One built cl/*.cl file."""

    def __init__(
        self,
        device: Device,
        name: str,
        source: str,
        *,
        options: list[str],
        defines: dict[str, Any],
    ):
        self.device = device
        signatures = parse_signatures(source, f"cl/{name}.cl")
        try:
            with quiet_compiler():
                built = cl.Program(device.context, source).build(options=options)
        except cl.RuntimeError as error:
            raise BuildError(
                f"cl/{name}.cl does not build on {device.name} with {' '.join(options)}", str(error)
            ) from error
        self.kernels = {
            k: Kernel(built, k, device.device, p, defines=defines, label=f"{name}.cl:{k}")
            for k, p in signatures.items()
        }

    def launch(
        self,
        kernel_name: str,
        size: int | tuple[int, ...],
        local: int | tuple[int, ...] | None = None,
        *,
        multiply_adds: float = 0,
        along: int = 0,
        **arguments,
    ) -> None:
        """Enqueue one kernel.

        size: int or tuple of work-items, rounded up to the work-group size (kernels guard their
        tail); nothing is launched when it is 0. local: work-group size; None = DEFAULT_LOCAL.
        multiply_adds: upper bound of the total; if they may take too long for a watchdog, several
        launches share the work-items, cut along dimension `along`, in which the kernel must use
        only global ids. arguments: by parameter name. Raises TypeError (names, dtypes) and
        ValueError (shapes) before anything is enqueued, UserError when the work-group is too large
        for the device or the driver fails.
        """
        kernel = self.kernels[kernel_name]
        values = kernel.arguments(arguments)
        ranges = kernel.ranges(size, local)
        if ranges is None:
            return
        size, local = ranges
        watched = multiply_adds > 0 and self.device.has_watchdog
        parts = math.ceil(multiply_adds / MOST_MULTIPLY_ADDS) if watched else 1
        for offset, part in cut(size, local, parts, along) if parts > 1 else [(None, size)]:
            self.device.enqueue(Launch(kernel, part, local, offset, values, arguments, watched))
