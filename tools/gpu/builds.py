"""Which programs the drivers build on a GPU: tools/gpu/builds.json.

    python -m tools.gpu.builds            # compare; exit status 1 where they are others by now
    python -m tools.gpu.builds --write    # write them

The drivers of tools/gpu/drivers.py run on the device at hand, a CPU's, which they take for a GPU.
"""

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyopencl as cl

from pp_cl.device.device import Device
from pp_cl.device.discover import open_device
from pp_cl.device.launch import Program
from tools.gpu.drivers import run_all

FILE = Path(__file__).with_suffix(".json")


@dataclass(frozen=True, order=True)
class Build:
    """One program: cl/<file>.cl, built with -D for each macro "NAME=value"."""

    file: str
    macros: tuple[str, ...]

    @property
    def label(self) -> str:
        """The file and the macros."""
        return " ".join((self.file, *self.macros))


Builds = dict[Build, set[str]]  # the kernels that are launched of each


class GpuDevice(Device):
    """A device that drivers take for a GPU. builds: what they have built and launched."""

    def __init__(self, device: cl.Device):
        super().__init__(device)
        self.is_cpu = False
        # of no vendor, whose options the device at hand would refuse
        self.info |= {"type": "GPU", "platform": "any"}
        self.builds: Builds = {}

    def program(self, name: str, **defines: int | float | str) -> "Recorded":
        """As Device.program()."""
        build = Build(name, tuple(f"{k}={v}" for k, v in sorted(defines.items())))
        kernels = self.builds.setdefault(build, set())
        return Recorded(super().program(name, **defines), kernels)


class Recorded:
    """A program that notes which of its kernels are launched."""

    def __init__(self, program: Program, kernels: set[str]):
        self._program = program
        self._kernels = kernels

    def launch(self, kernel_name: str, *args, **kwargs) -> None:
        """As Program.launch()."""
        self._kernels.add(kernel_name)
        self._program.launch(kernel_name, *args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._program, name)


def record(device: cl.Device) -> Builds:
    """What all drivers build and launch on a device that they take for a GPU."""
    dev = GpuDevice(device)
    run_all(dev)
    return dev.builds


def read_builds(file: Path | None = None) -> Builds:
    """The builds that write_builds() wrote. file: None = FILE."""
    rows = json.loads((file or FILE).read_text("utf-8"))
    return {Build(row["file"], tuple(row["macros"])): set(row["kernels"]) for row in rows}


def write_builds(builds: Builds, file: Path | None = None) -> None:
    """One build a line. file: None = FILE."""
    rows = [
        json.dumps({"file": b.file, "macros": b.macros, "kernels": sorted(kernels)})
        for b, kernels in sorted(builds.items())
    ]
    (file or FILE).write_text("[\n" + ",\n".join(rows) + "\n]\n", "utf-8")


def differences(recorded: Builds, stored: Builds) -> list[str]:
    """What the drivers build or launch and the file does not name, and the other way round."""
    ours, theirs = (
        {build.label for build in builds}
        | {f"{build.label}: {kernel}" for build, kernels in builds.items() for kernel in kernels}
        for builds in (recorded, stored)
    )
    new = [f"new: {what}" for what in sorted(ours - theirs)]
    return new + [f"gone: {what}" for what in sorted(theirs - ours)]


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", action="store_true", help=f"write {FILE.name} anew")
    write = parser.parse_args(arguments).write
    builds = record(open_device().device)
    if write:
        write_builds(builds)
        return 0
    found = differences(builds, read_builds())
    if found:
        print(*found, sep="\n", file=sys.stderr)
        print(
            "the drivers build other programs than tools/gpu/builds.json names:"
            " python -m tools.gpu.builds --write, then make gpu-check",
            file=sys.stderr,
        )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
