"""The two forms of drivers and kernels: a CPU's and a GPU's. dev: a pp_cl.device.device.Device."""

import os
from typing import Any

import pyopencl as cl

from pp_cl.errors import UserError

SMALL_GROUP = 64  # work-items: no fewer fill what a GPU runs in step
LARGEST_GROUP = 256  # work-items: what GPUs run of any kernel


def takes_cpu_form(device: cl.Device) -> bool:
    """Whether drivers and kernels take their form for CPUs: on CPUs, unless PP_FORM=gpu.

    Raises UserError for another PP_FORM.
    """
    form = os.environ.get("PP_FORM")
    if form not in (None, "", "gpu"):
        raise UserError(f"PP_FORM={form}: must be gpu, or unset")
    return not form and bool(device.type & cl.device_type.CPU)


def lanes(dev: Any, on_gpu: int = 1) -> int:
    """LANES of kernels (cl/lanes.h): neighbouring values that one work-item handles.

    on_gpu: how many on GPUs, 1 or 4.

    A CPU's core has vectors of 16 floats and works on one item at a time. A GPU runs 32 or 64 items
    in step, which reach memory together, and keeps the values of each in registers: 16 of
    everything do not fit.
    """
    return 16 if dev.is_cpu else on_gpu


def channel_ranges(
    dev: Any, height: int, width: int, channels: int
) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """(work-items, work-group) of a kernel with an item per (LANES channels, x, y) of a feature map
    (height, width, channels). On GPUs those in step are neighbours in memory.
    """
    n = lanes(dev)
    return (-(-channels // n), width, height), (1, 16, 4) if dev.is_cpu else (16, 4, 1)


def row_parts(dev: Any, on_gpu: int = 1) -> int:
    """Work-items for the 16 channels of a row, LANES each. on_gpu: as for lanes()."""
    return 16 // lanes(dev, on_gpu)


def group_items(dev: Any) -> int:
    """GROUP of kernels (cl/group.h): work-items that sum or scan together; a power of two on GPUs,
    1 on CPUs. Of kernels that the device runs in fewer, launch_groups() takes less.
    """
    if dev.is_cpu:
        return 1
    most = min(LARGEST_GROUP, dev.device.max_work_group_size)
    return 1 << most.bit_length() - 1


def launch_groups(
    dev: Any,
    name: str,
    kernel: str,
    groups: int,
    *,
    defines: dict[str, int] | None = None,
    **arguments,
) -> None:
    """Launch a kernel of cl/<name>.cl in which GROUP work-items work together, `groups` times. A
    GPU's compiler may allow fewer of one kernel than the device runs of others.

    defines: of the program, beside GROUP. arguments: by parameter name.
    """
    items, defines = group_items(dev), defines or {}
    program = dev.program(name, GROUP=items, **defines)
    while items > 1 and items > program.kernels[kernel].largest_group:
        items //= 2
        program = dev.program(name, GROUP=items, **defines)
    local = None if dev.is_cpu else items
    program.launch(kernel, groups * items, local, **arguments)


def group_ranges(dev: Any, groups: int, members: int) -> tuple[int, int | None]:
    """(work-items, work-group) of a kernel in which `members` work together, `groups` times; on
    CPUs one work-item each. A work-group holds groups as a whole.
    """
    return (groups, None) if dev.is_cpu else (groups * members, max(members, SMALL_GROUP))
