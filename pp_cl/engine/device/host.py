"""Memory of the machine that the program runs on."""

import ctypes
import mmap
import sys
from pathlib import Path

GROUP = Path("/sys/fs/cgroup")  # of this process, as a container shows it
PROC = Path("/proc")


def available_bytes() -> int | None:
    """What this process may hold in all: what it holds now and what is free, of the machine and of
    its container. None where the system does not tell.
    """
    try:
        lines = dict(line.split(":") for line in (PROC / "meminfo").read_text().splitlines())
        free = int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return None
    return min([free, *_free_in_group()]) + resident_bytes()


def resident_bytes() -> int:
    """Memory that this process holds; 0 where the system does not tell."""
    try:
        pages = int((PROC / "self/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0
    return pages * mmap.PAGESIZE


def ask_for_huge_pages(address: int, nbytes: int) -> None:
    """Ask Linux for pages of 2 MiB in memory that is not in use yet: among those of 4 KiB, which
    most systems give to those who do not ask, random accesses spend much of their time looking up
    pages. Does nothing elsewhere.
    """
    if sys.platform == "linux":
        first = -(-address // mmap.PAGESIZE) * mmap.PAGESIZE
        size = (address + nbytes - first) // mmap.PAGESIZE * mmap.PAGESIZE
        madvise = ctypes.CDLL(None).madvise
        madvise(ctypes.c_void_p(first), ctypes.c_size_t(size), mmap.MADV_HUGEPAGE)


def _free_in_group():
    """[bytes below the container's limit], [] where it has none. Its cached files are given up."""
    try:
        limit, used = (
            (GROUP / name).read_text().strip() for name in ("memory.max", "memory.current")
        )
        stat = dict(line.split() for line in (GROUP / "memory.stat").read_text().splitlines())
        return [int(limit) - int(used) + int(stat["inactive_file"])] if limit.isdigit() else []
    except (OSError, KeyError, ValueError):
        return []
