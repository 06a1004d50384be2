"""The command pp-cl tune."""

import argparse

from pp_cl.commands import options as shared
from pp_cl.config import PRESETS, preset

HELP = "time the variants of the convolutions on this device, keep the fastest"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("--preset", choices=PRESETS, help="whose network and sizes (tiny)")
    parser.add_argument(
        "--widths", metavar="A,B,C", help="channels of the levels, if not the preset's"
    )
    parser.add_argument(
        "--size",
        metavar="S",
        help="side of the image in pixels, a multiple of 4, if not the preset's",
    )
    shared.add_tolerance(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, store the tuning."""
    from pp_cl.bench.tune import EVALUATED, run_tune

    config = preset(options.preset or "tiny")
    tolerance = shared.read_tolerance(options.tolerance)
    if tolerance is None:
        tolerance = config.network.tolerance
    evaluated = EVALUATED[config.preset]
    size, widths = shared.read_shape(
        options.size or str(evaluated), options.widths or ",".join(map(str, config.network.widths))
    )
    training = size if options.size else config.train.crop or evaluated
    run_tune(widths, training, size, tolerance, options.device)
