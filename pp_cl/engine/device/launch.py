"""How many values a work-item takes and how many work together, on CPUs and on GPUs; and launches
that are prepared once.
"""

from collections.abc import Callable
from typing import Any

from pp_cl.engine.device.device import Device, Launch

SMALL_GROUP = 64  # work-items: no fewer fill what a GPU runs in step
LARGEST_GROUP = 256  # work-items: what GPUs run of any kernel


def lanes(dev: Device, on_gpu: int = 1) -> int:
    """LANES of kernels (cl/lanes.h): neighbouring values that one work-item takes. on_gpu: how many
    on GPUs, 1 or 4.

    A CPU's core has vectors of 16 floats and works on one item at a time. A GPU runs 32 or 64 items
    in step, which reach memory together, and keeps the values of each in registers: 16 of
    everything do not fit.
    """
    return 16 if dev.is_cpu else on_gpu


def row_parts(dev: Device, on_gpu: int = 1) -> int:
    """Work-items for the 16 channels of a row, LANES each. on_gpu: as for lanes()."""
    return 16 // lanes(dev, on_gpu)


def channel_ranges(
    dev: Device, height: int, width: int, channels: int
) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """(work-items, work-group) of a kernel with an item per (LANES channels, x, y) of a feature map
    (height, width, channels). On GPUs those in step are neighbours in memory.
    """
    size = (-(-channels // lanes(dev)), width, height)
    return size, (1, 16, 4) if dev.is_cpu else (16, 4, 1)


def group_ranges(dev: Device, groups: int, members: int) -> tuple[int, int | None]:
    """(work-items, work-group) of a kernel in which groups of `members` work-items cooperate; on
    CPUs a group is one work-item. A work-group holds one or more groups as a whole.
    """
    return (groups, None) if dev.is_cpu else (groups * members, max(members, SMALL_GROUP))


def group_items(dev: Device) -> int:
    """GROUP of kernels (cl/group.h): work-items that sum or scan together; a power of two on GPUs,
    1 on CPUs. Of kernels that the device runs in fewer, launch_groups() takes less.
    """
    if dev.is_cpu:
        return 1
    return 1 << min(LARGEST_GROUP, dev.device.max_work_group_size).bit_length() - 1


def launch_groups(
    dev: Device,
    name: str,
    kernel: str,
    groups: int,
    *,
    most: int = LARGEST_GROUP,
    defines: dict[str, Any] | None = None,
    **arguments,
) -> None:
    """Launch a kernel of cl/<name>.cl in which GROUP work-items work together, `groups` times, each
    a work-group. A GPU's compiler may allow fewer of one kernel than the device runs of others.

    most: work-items of a group, a power of two. defines: of the program, to which GROUP is added.
    arguments: by parameter name.
    """
    items, defines = min(most, group_items(dev)), defines or {}
    program = dev.program(name, **defines | {"GROUP": items})
    while items > 1 and items > program.kernels[kernel].largest_group:
        items //= 2
        program = dev.program(name, **defines | {"GROUP": items})
    program.launch(kernel, groups * items, items, **arguments)


class Prepared:
    """The launches and fills of a function, which are checked when it runs and repeated as they
    were from then on, by kernels whose arguments stay set.
    """

    def __init__(self, dev: Device):
        self._dev = dev
        self._given: tuple[Any, ...] = ()
        self._launches: list[Any] | None = None
        self._result: Any = None

    def run(self, function: Callable[..., Any], *given: Any, **named: Any) -> Any:
        """Enqueue what function(*given, **named) launches and fills, and return what it returns,
        all of which depends on these objects and numbers alone; what else it does to the device
        must last.
        """
        asked = *given, *named.values()
        if self._launches is None or not all(map(_is_same, asked, self._given)):
            self._launches = self._result = None  # frees their arrays
            self._given = asked
            launches: list[Any] = []
            self._dev.recorded = launches
            try:
                self._result = function(*given, **named)
            finally:
                self._dev.recorded = None
            self._launches = launches
            return self._result
        for i, launch in enumerate(self._launches):
            if not isinstance(launch, Launch):
                launch()
                continue
            if launch.own is None:  # many would be gone before they are repeated
                own = launch.kernel.with_arguments(launch.values, for_good=True)
                launch = self._launches[i] = launch._replace(own=own)
            self._dev.enqueue(launch)
        return self._result


def _is_same(a, b):
    """Whether they are one object, or equal numbers."""
    return a is b or (isinstance(a, int | float | str | tuple) and a == b)
