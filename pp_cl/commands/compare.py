"""The command pp-cl compare."""

import argparse

from pp_cl.commands import options as shared

HELP = "measure one image, or a folder of images, against the truth"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("prediction", metavar="PRED", help="image, or folder of images")
    parser.add_argument("truth", metavar="TRUTH", help="the same of what it should be")
    shared.add_metrics(parser)
    parser.add_argument("--json", metavar="FILE", help="also write the result there")
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, print the means."""
    from pp_cl.device.discover import open_device
    from pp_cl.files.atomic import write_json
    from pp_cl.metrics.compare import compare

    metrics = shared.read_metrics(options.metrics)
    dev = open_device(options.device) if "lpips" in metrics else None
    result = compare(options.prediction, options.truth, metrics, dev)
    if options.json:
        write_json(options.json, result)
    for name, value in result["mean"].items():
        print(f"{name:6s} {value:.4f}")
