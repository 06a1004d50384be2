"""What kernels take too much of, and the list of what is known of it, tools/gpu/known.json.

The list is there to become shorter: a complaint that is not in it fails, and so does an entry
without its complaint.
"""

import json
from pathlib import Path

from tools.gpu.compilers import Usage

FILE = Path(__file__).with_suffix(".json")
# Adreno, Mali, Apple's and older Intel GPUs have no more.
MOST_LOCAL = 32768
# With 128, NVIDIA runs two work-groups of 256 at a time, RDNA 12 waves a SIMD, CDNA 4. Of Intel a
# thread has 128 or 256, whatever it needs.
MOST_REGISTERS = 128
NARROW = 8  # lanes of Intel's narrowest threads, which run at half speed
# By so much a number may exceed the known one: register allocation is not the same each time.
SLACK = 1 / 16

Complaints = dict[str, dict[str, int]]  # {"target build: kernel": {what: how much}}


def complaints(usage: Usage) -> dict[str, int]:
    """{what: how much} of a kernel's use that is too much."""
    found = {"spill": usage.spill, "private": usage.private}
    if usage.simd is None:
        found["registers"] = usage.registers * (usage.registers > MOST_REGISTERS)
    else:
        found["narrow"] = usage.simd * (usage.simd <= NARROW)
    return {what: number for what, number in found.items() if number}


def read_known() -> Complaints:
    """The list."""
    return json.loads(FILE.read_text("utf-8"))


def write_known(known: Complaints) -> None:
    """One kernel a line."""
    rows = [f"{json.dumps(kernel)}: {json.dumps(known[kernel])}" for kernel in sorted(known)]
    FILE.write_text("{\n" + ",\n".join(rows) + "\n}\n", "utf-8")


def news(found: Complaints, known: Complaints) -> list[str]:
    """Lines about complaints that the list does not have, or has with a clearly smaller number."""
    lines = []
    for kernel, numbers in sorted(found.items()):
        for what, number in numbers.items():
            allowed = known.get(kernel, {}).get(what)
            if allowed is None:
                lines.append(f"{kernel}: {what} {number}")
            elif number > allowed * (1 + SLACK):
                lines.append(f"{kernel}: {what} {number}, known with {allowed}")
    return lines


def leftovers(found: Complaints, known: Complaints) -> list[str]:
    """Lines about entries of the list without a complaint."""
    return [
        f"{kernel}: {what} is in {FILE.name} and no longer true"
        for kernel, numbers in sorted(known.items())
        for what in numbers
        if what not in found.get(kernel, {})
    ]


def shortened(found: Complaints, known: Complaints) -> Complaints:
    """The list without leftovers, with the least numbers; nothing is added."""
    kept = {
        kernel: {
            what: min(number, found[kernel][what])
            for what, number in numbers.items()
            if what in found.get(kernel, {})
        }
        for kernel, numbers in known.items()
    }
    return {kernel: numbers for kernel, numbers in kept.items() if numbers}
