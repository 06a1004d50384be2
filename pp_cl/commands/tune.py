"""`pp-cl tune`: times the convolution variants on a device and stores the result."""

import argparse
import time
from functools import partial

from pp_cl.commands import options as shared
from pp_cl.config import assign, preset
from pp_cl.presets import IMAGE_SIZES, PRESETS

UNREDUCED = 800  # pixels: side of the usual photographs where a preset takes them as they are

HELP = "time the variants of the convolutions on this device, keep the fastest"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("--preset", choices=PRESETS, help="preset of network and sizes (tiny)")
    shared.add_widths(parser, "channels of the levels, if not the preset's")
    parser.add_argument(
        "--size",
        type=shared.side,
        metavar="S",
        help="side of the image in pixels, a multiple of 4, if not the preset's",
    )
    shared.add_tolerance(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, print what is taken, store the tuning."""
    from pp_cl.bench import tune
    from pp_cl.device.discover import open_device
    from pp_cl.layers.choice import make_policy
    from pp_cl.network.layers import unet_layers

    config, training, size = _read_network(options)
    net = config.network
    tolerance = net.tolerance if options.tolerance is None else options.tolerance
    dev = open_device(options.device)
    tune.check_cache()
    print(
        f"{dev.name} [{dev.info['platform']}], widths {','.join(map(str, net.widths))}, "
        f"blocks {net.blocks}, training at {training}x{training}, evaluation at {size}x{size}"
    )
    start = time.perf_counter()
    layers = unet_layers(net.widths, blocks=net.blocks, channels=net.channel_numbers)
    cases = tune.network_cases(layers, training, size)
    tuning, shipped_ms = tune.run_tune(dev, cases, tolerance, partial(print, flush=True))
    print(f"stored in {tune.store(dev, tuning)} ({time.perf_counter() - start:.0f} s)")
    policy = make_policy(dev, tolerance, tuning)
    for what, (shipped, tuned) in tune.total_times(
        cases, tuning["rows"], shipped_ms, policy
    ).items():
        print(
            f"convolutions of {what}: {shipped:.2f} ms as shipped, {tuned:.2f} ms as tuned, "
            f"{shipped / tuned:.2f} times as fast"
        )


def _read_network(options):
    """(Config of the network asked for, sides of its images in training and in evaluation)."""
    config = preset(options.preset or "tiny")
    evaluated = IMAGE_SIZES[config.preset] or UNREDUCED
    size = options.size or evaluated
    if options.widths:
        assign(config, "network.widths", options.widths, "--widths")
    return config, size if options.size else config.train.crop or evaluated, size
