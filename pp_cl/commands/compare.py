"""`pp-cl compare`: PSNR, SSIM and LPIPS of images against the ground truth."""

import argparse

from pp_cl.commands import options as shared

HELP = "measure one image, or a folder of images, against the truth"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("prediction", metavar="PRED", help="image, or folder of images")
    parser.add_argument("truth", metavar="TRUTH", help="the same of what it should be")
    shared.add_metrics(parser)
    shared.add_json(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, print the means."""
    from pp_cl.device.discover import open_device
    from pp_cl.metrics.compare import compare

    dev = open_device(options.device) if "lpips" in options.metrics else None
    result = compare(options.prediction, options.truth, options.metrics, dev)
    lines = [f"{name:6s} {value:.4f}" for name, value in result["mean"].items()]
    shared.tell(options.json, result, lines)
