"""`pp-cl devices`: lists the OpenCL devices and whether each one works."""

import argparse

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "list the OpenCL devices and whether they work"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    shared.add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Print the devices, and which one is taken. Raises UserError if none works."""
    from pp_cl.drivers import list_devices, list_left_out, mend
    from pp_cl.engine.device.device import describe
    from pp_cl.speeds import by_speed

    found, harmful = list_devices(again=True), list_left_out()
    taken = [index for index, _, _ in by_speed(found)]
    rows = [
        {"index": i, **describe(device), "problem": problem, "default": [i] == taken[:1]}
        for i, device, problem in found
    ]
    lines = [
        f"{row['index']}  {row['name']}  [{row['platform']}]  "
        f"{row['compute_units']} units, {row['memory_bytes'] / 2**30:.1f} GiB: "
        f"{row['problem'] or 'works'}{', taken by default' if row['default'] else ''}"
        for row in rows
    ]
    rows += [{"index": None, "name": name, "problem": problem} for name, problem in harmful]
    lines += [f"left out  {name}: {problem}" for name, problem in harmful]
    shared.tell(options.json, rows, lines)
    if not taken:
        raise UserError(f"no working OpenCL device: {mend()}")
