"""`pp-cl selftest`: compares the kernels on a device with float64."""

import argparse

from pp_cl.commands import options as shared
from pp_cl.errors import Stopped

HELP = "compare the kernels with float64 on this device, hard cases included"
EPILOG = """\
Each line is a case: the error that came closest to its bound, the bound, and whether it holds; with
--hard also the error of a naive formula for the same input. What is printed is meant to be pasted
into a report of a fault. Exit status: 0 all cases pass, 1 some fail, 2 there is no such device."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "--hard",
        action="store_true",
        help="the hard cases alone, beside what naive formulas in float32 give",
    )
    shared.add_json(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Run the cases, print the table. Raises Stopped, which names the failed cases, if any fail."""
    from pp_cl.drivers import open_device
    from pp_cl.selftest import run as selftest

    dev = open_device(options.device)
    for what, name in selftest.setup(dev).items():
        print(f"{what:14}{name}")
    cases, head, line = selftest.CASES, selftest.HEAD, selftest.line
    if options.hard:
        cases = tuple(case for case in cases if case.hard)
        head, line = selftest.HARD_HEAD, selftest.hard_line
    print(f"\n{head}", flush=True)
    rows = []
    for row in selftest.run_cases(dev, cases):
        rows.append(row)
        print(line(row), flush=True)
    shared.write_json_option(options.json, selftest.as_json(dev, rows))
    seconds, failed = sum(row.seconds for row in rows), [row.case for row in rows if not row.passed]
    print(f"\n{len(rows)} cases in {seconds:.0f} s, {len(rows) - len(failed)} pass", flush=True)
    if failed:
        raise Stopped(f"selftest: {len(failed)} failed: {'; '.join(failed)}", 1)
