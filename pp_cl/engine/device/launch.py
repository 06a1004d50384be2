"""How many values a work-item processes and how many work-items cooperate, on CPUs and on GPUs; and
replayed(), which has a function's launches checked once.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, ParamSpec, TypeVar

from pp_cl.engine.device.device import Device

P = ParamSpec("P")
R = TypeVar("R")

SMALL_GROUP = 64  # work-items: the fewest that fill what a GPU runs in step
LARGEST_GROUP = 256  # work-items: GPUs can run this many of any kernel


def lanes(dev: Device, on_gpu: int = 1) -> int:
    """LANES of kernels (cl/lanes.h): how many neighbouring values one work-item processes. on_gpu:
    the number on GPUs, 1 or 4.

    A CPU's core has vectors of 16 floats and works on one item at a time. A GPU runs 32 or 64 items
    in step, which access memory together, and keeps each item's values in registers, which cannot
    hold 16 of every value.
    """
    return 16 if dev.is_cpu else on_gpu


def row_parts(dev: Device, on_gpu: int = 1) -> int:
    """Work-items for the 16 channels of a row, LANES each. on_gpu: as for lanes()."""
    return 16 // lanes(dev, on_gpu)


def channel_ranges(
    dev: Device, height: int, width: int, channels: int
) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """(work-items, work-group) of a kernel with an item per (LANES channels, x, y) of a feature map
    (height, width, channels). On GPUs, items that run in step access neighbouring memory.
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
    1 on CPUs. If the device allows fewer work-items for a kernel, launch_groups() halves the group.
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
    """Launch a kernel of cl/<name>.cl with `groups` work-groups of GROUP cooperating work-items.
    GROUP is halved until the device can run it, as compilers may allow fewer for one kernel.

    most: largest GROUP, a power of two. defines: macros of the program, apart from GROUP.
    arguments: by parameter name.
    """
    items, defines = min(most, group_items(dev)), defines or {}
    program = dev.program(name, **defines | {"GROUP": items})
    while items > 1 and items > program.kernels[kernel].largest_group:
        items //= 2
        program = dev.program(name, **defines | {"GROUP": items})
    program.launch(kernel, groups * items, items, **arguments)


class Call(NamedTuple):
    """A recorded call of a function: its arguments, its launches and fills, and its result.
    scratch: Device.scratch_version after the call, as its launches refer to scratch memory of that
    version.
    """

    scratch: int
    given: tuple[Any, ...]
    launches: list[Any]
    result: Any


def replayed(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function record its launches and fills: called again with the same objects and
    numbers, it enqueues them again without checks, by kernels whose arguments stay set, and returns
    the same result.

    The launches and the result must depend on the arguments alone, and any other effect on the
    device must last; the tests' device checks every replay. The second argument, a Workspace or
    Buffers, stores the call and drops it before it allocates.
    """

    @functools.wraps(function)
    def replaying(*args: P.args, **named: P.kwargs) -> R:
        place: Any = args[1]
        # without args[0], the place's device or network, which the call would keep alive
        dev, arguments = place.dev, (*args[2:], *named, *named.values())
        call = place.calls.get(function)
        version = dev.scratch_version
        if call is None or call.scratch != version or not _are_same(arguments, call.given):
            call = None
            place.calls.pop(function, None)  # frees its arrays
            with dev.recording() as launches:
                result = function(*args, **named)
            place.calls[function] = Call(dev.scratch_version, arguments, launches, result)
            return result
        if dev.doubts:
            dev.compare(call.launches, lambda: function(*args, **named))
        dev.replay(call.launches)
        return call.result

    return replaying


def _are_same(values, before):
    """Whether each value is the same object as before, or an equal number, string or tuple."""
    return len(values) == len(before) and all(map(_is_same, values, before))


def _is_same(a, b):
    return a is b or (isinstance(a, int | float | str | tuple) and a == b)
