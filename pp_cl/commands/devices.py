"""`pp-cl devices`: lists the OpenCL devices and whether each one works."""

import argparse

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "list the OpenCL devices and whether they work"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    shared.add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Print the devices and which one is used. Raises UserError if none works."""
    from pp_cl.drivers import list_devices, list_left_out, mend
    from pp_cl.engine.device.quirks import describe
    from pp_cl.speeds import by_speed

    devices, harmful = list_devices(again=True), list_left_out()
    taken = [index for index, _, _ in by_speed(devices)]
    rows, lines = [], []
    for index, device, problem in devices:
        row, is_default = describe(device), [index] == taken[:1]
        rows.append({"index": index, **row, "problem": problem, "default": is_default})
        lines.append(
            f"{index}  {row['name']}  [{row['platform']}]  {row['compute_units']} units,"
            f" {row['memory_bytes'] / 2**30:.1f} GiB:"
            f" {problem or 'works'}{', taken by default' * is_default}"
        )
    for name, problem in harmful:
        rows.append({"index": None, "name": name, "problem": problem})
        lines.append(f"left out  {name}: {problem}")
    shared.tell(options.json, rows, lines)
    if not taken:
        raise UserError(f"no working OpenCL device: {mend()}")
