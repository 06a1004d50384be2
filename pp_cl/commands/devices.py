"""The command pp-cl devices."""

import argparse
import json

from pp_cl.errors import UserError

HELP = "list the OpenCL devices and whether they work"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> None:
    """Print the devices. Raises UserError if none works."""
    from pp_cl.device.device import describe
    from pp_cl.device.discover import MEND, list_devices

    found = [(i, describe(d), problem) for i, d, problem in list_devices()]
    if options.json:
        rows = [{"index": i, **info, "problem": problem} for i, info, problem in found]
        print(json.dumps(rows, indent=1))
    else:
        for i, info, problem in found:
            print(
                f"{i}  {info['name']}  [{info['platform']}]  "
                f"{info['compute_units']} units, {info['memory_bytes'] / 2**30:.1f} GiB: "
                f"{problem or 'works'}"
            )
    if not any(problem is None for _, _, problem in found):
        raise UserError(f"no working OpenCL device: {MEND}")
