"""`pp-cl devices`: lists the OpenCL devices and whether each one works."""

import argparse

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "list the OpenCL devices and whether they work"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    shared.add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Print the devices. Raises UserError if none works."""
    from pp_cl.drivers import list_devices, list_left_out, mend
    from pp_cl.engine.device.device import describe

    found = [(i, describe(d), problem) for i, d, problem in list_devices(again=True)]
    harmful = list_left_out()
    rows = [{"index": i, **info, "problem": problem} for i, info, problem in found]
    rows += [{"index": None, "name": name, "problem": problem} for name, problem in harmful]
    lines = [
        f"{i}  {info['name']}  [{info['platform']}]  "
        f"{info['compute_units']} units, {info['memory_bytes'] / 2**30:.1f} GiB: "
        f"{problem or 'works'}"
        for i, info, problem in found
    ]
    lines += [f"left out  {name}: {problem}" for name, problem in harmful]
    shared.tell(options.json, rows, lines)
    if not any(problem is None for _, _, problem in found):
        raise UserError(f"no working OpenCL device: {mend()}")
