"""What devices report about themselves, and how their drivers differ."""

import os
import signal
import threading
from pathlib import Path
from typing import Any

import pyopencl as cl

from pp_cl.errors import UserError

# Platform of Intel's GPU driver; other drivers of that vendor refuse options they do not know.
INTEL_PLATFORM = "Intel(R) OpenCL"
# Files with a kernel that spills registers, or becomes narrow, with Intel's default of 128
# registers a thread but not with 256, with which half as many threads run (docs/devices.md).
SPILLING_ON_INTEL = frozenset(
    (
        "layers/conv_backward",
        "layers/conv_local",
        "layers/conv_local_backward_weights",
    )
)

# Platforms of drivers for CPUs. Bytes of host memory that their compilers use until all kernels of
# a training are built; for other platforms, the largest is assumed. They take clang's prefetches,
# with which rusticl's software renderer ends the process (Mesa 22.3).
COMPILER_BYTES = {"Portable Computing Language": 80 * 2**20, "Intel(R) OpenCL": 620 * 2**20}


def compiler_bytes(info: dict[str, Any]) -> int:
    """Bytes of host memory that the driver's compiler uses in a training. info: from describe()."""
    return COMPILER_BYTES.get(info["platform"], max(COMPILER_BYTES.values()))


def vendor_options(info: dict[str, Any], name: str) -> tuple[str, ...]:
    """Build options of cl/<name>.cl specific to the device's vendor. info: from describe()."""
    if info["type"] == "CPU" and info["platform"] in COMPILER_BYTES:
        return ("-DREADS_AHEAD",)
    intel_gpu = info["type"] == "GPU" and info["platform"].startswith(INTEL_PLATFORM)
    large = intel_gpu and name in SPILLING_ON_INTEL
    return ("-cl-intel-256-GRF-per-thread",) if large else ()


def has_watchdog(device: cl.Device) -> bool:
    """Whether the system may stop a long kernel; True if unknown, as only NVIDIA's driver tells."""
    try:
        return bool(device.kernel_exec_timeout_nv)
    except (cl.Error, AttributeError):
        return True


def acts_as_cpu(device: cl.Device) -> bool:
    """Whether drivers and kernels work as they do on CPUs: on CPUs, unless PP_FORM=gpu.

    Raises UserError for another PP_FORM.
    """
    asked = os.environ.get("PP_FORM")
    if asked not in (None, "", "gpu"):
        raise UserError(f"PP_FORM={asked}: must be gpu, or unset")
    return not asked and bool(device.type & cl.device_type.CPU)


def describe(device: cl.Device) -> dict[str, Any]:
    """A cl.Device's "name", "platform", "version", "driver", "type", "compute_units",
    "memory_bytes", "max_allocation_bytes" in a dictionary.
    """
    return {
        "name": device.name.strip(),
        "platform": device.platform.name.strip(),
        "version": device.version.strip(),
        "driver": device.driver_version.strip(),
        "type": _type_name(device),
        "compute_units": device.max_compute_units,
        "memory_bytes": _memory_bytes(device),
        "max_allocation_bytes": _max_allocation_bytes(device),
    }


def _type_name(device):
    return next(
        (t for t in ("GPU", "CPU", "ACCELERATOR") if device.type & getattr(cl.device_type, t)),
        "OTHER",
    )


def _memory_bytes(device):
    """Bytes of a GPU's memory; for a CPU those of the machine or its container, as PoCL reports a
    fraction but does not enforce it.
    """
    if not (device.type & cl.device_type.CPU and hasattr(os, "sysconf")):
        return device.global_mem_size
    sizes = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        if os.path.exists(limit):
            text = Path(limit).read_text().strip()
            sizes += [int(text)] if text.isdigit() else []  # "max": no limit
    return min(sizes)


def _max_allocation_bytes(device):
    """Bytes that the device allocates at once, or PP_MAX_ALLOCATION (MiB) if that is less."""
    text = os.environ.get("PP_MAX_ALLOCATION") or "inf"
    try:
        mebibytes = float(text)
    except ValueError:
        mebibytes = 0.0
    if not mebibytes > 0:
        raise UserError(f"PP_MAX_ALLOCATION={text}: must be a number of MiB above 0")
    return int(min(device.max_mem_alloc_size, mebibytes * 2**20))


def ignore_full_files() -> None:
    """Let a write beyond the limit of a file's size raise its error, as Python does: LLVM in
    drivers catches the signal, asks for a bug report and ends the program.
    """
    if hasattr(signal, "SIGXFSZ") and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
