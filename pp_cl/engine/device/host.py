"""Memory of the machine that the program runs on."""

import ctypes
import mmap
import sys
from pathlib import Path

import psutil

GROUP = Path("/sys/fs/cgroup")  # the process's control group, as a container shows it


def available_bytes() -> int:
    """Bytes of memory that this process may hold in total: its present memory plus the memory free
    on the machine and in its container.
    """
    return min([psutil.virtual_memory().available, *_free_in_group()]) + resident_bytes()


def resident_bytes() -> int:
    """Bytes of memory that this process holds."""
    return psutil.Process().memory_info().rss


def ask_for_huge_pages(address: int, nbytes: int) -> None:
    """Ask Linux for pages of 2 MiB in memory that is not in use yet: with pages of 4 KiB, the
    default of most systems, random accesses spend much of their time looking up pages. Does nothing
    on other systems.
    """
    if sys.platform == "linux":
        first = -(-address // mmap.PAGESIZE) * mmap.PAGESIZE
        size = (address + nbytes - first) // mmap.PAGESIZE * mmap.PAGESIZE
        madvise = ctypes.CDLL(None).madvise
        madvise(ctypes.c_void_p(first), ctypes.c_size_t(size), mmap.MADV_HUGEPAGE)


def _free_in_group():
    """[bytes left below the container's limit], [] if it has none. Cached files count as free."""
    try:
        limit, used = (
            (GROUP / name).read_text().strip() for name in ("memory.max", "memory.current")
        )
        stat = dict(line.split() for line in (GROUP / "memory.stat").read_text().splitlines())
        return [int(limit) - int(used) + int(stat["inactive_file"])] if limit.isdigit() else []
    except (OSError, KeyError, ValueError):
        return []
