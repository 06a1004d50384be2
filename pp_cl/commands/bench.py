"""`pp-cl bench`: measures time and error of a run's renderings, and of convolutions, network,
rasteriser and training steps.
"""

import argparse
import os
from itertools import chain
from typing import Any

from pp_cl.commands import options as shared
from pp_cl.errors import UserError, quoted, require, suggestion
from pp_cl.settings import BLOCKS

HELP = "time against error of a run's renderings, or of the kernels and a training"
# the options that only some benches have
OPTIONS = {
    "conv": ("size", "widths", "blocks", "plot"),
    "unet": ("size", "widths", "blocks", "plot"),
    "raster": ("size", "scene", "points", "blend", "plot"),
    "train": ("scene", "points", "widths"),
    "all": ("plot",),
}
OF_RUN = ("scene", "metrics", "plot")  # the options for a run
# options for `all`, which takes 20 seconds on two cores once its kernels are built
SMALL: dict[str, dict[str, Any]] = {
    "conv": {"size": [128], "widths": (32, 64, 128)},
    "unet": {"size": [128], "widths": (32, 64, 128)},
    "raster": {"size": [200, 400], "points": [10_000, 250_000]},
    "train": {"points": [250_000], "widths": (32, 64, 128)},
}
WIDTHS = (128, 256, 512)  # the paper's


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add(
        "what",
        nargs="?",
        default="all",
        type=_what,
        metavar="|".join(("RUN", *OPTIONS)),
        help="RUN: a finished run, by settings that trade time for error;"
        " all (default): each of the others at small sizes; conv: every layer of the network;"
        " unet: all of it; raster: points; train: the last steps of a training",
    )
    add(
        "--size",
        type=shared.several(shared.integer(4, 4096, 4)),
        metavar="S,...",
        help="sides of the image in pixels, multiples of 4 (256; raster: 200,400,800)",
    )
    add(
        "--widths",
        type=shared.widths,
        metavar="A,B,C",
        help="conv, unet, train: channels of the levels (128,256,512: the paper's)",
    )
    add("--blocks", choices=BLOCKS, help="conv, unet: of a level (double)")
    add(
        "--scene",
        metavar="SCENE",
        help="what is timed. raster: made points, grid (discs on a grid, the default) or pulsar"
        " (discs at the places of Pulsar's benchmark); train: the folder of a scene, or the word"
        " demo (default); of a run: where its scene is now",
    )
    add(
        "--points",
        type=shared.several(shared.integer(8, 2**27)),
        metavar="N,...",
        help="raster: numbers of points (10 thousand to 4 million); train: of the hull (4 million)",
    )
    add(
        "--blend",
        type=shared.words(("alpha", "softmax")),
        metavar="B,...",
        help="raster: of alpha,softmax (both)",
    )
    shared.add_metrics(parser)
    parser.set_defaults(metrics=None)  # only a run has metrics
    shared.add_json(parser, OPTIONS)
    add(
        "--plot",
        type=shared.output_file(".png", ".svg", ".pdf"),
        metavar="FILE",
        help="also draw time against error there (.png, .svg, .pdf)",
    )
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, print the table, write the files asked for. Raises UserError, before anything is
    measured, for options that make no sense and files that cannot be written.
    """
    from pp_cl.bench.plots import plot_time_and_error
    from pp_cl.bench.timing import HEAD, line
    from pp_cl.drivers import open_device

    is_run = options.what not in OPTIONS
    own = OF_RUN if is_run else OPTIONS[options.what]
    foreign = {"metrics", *chain(*OPTIONS.values())} - {*own}
    of = "a run" if is_run else options.what
    shared.refuse(options, foreign, f"bench {of} has no such option")
    if options.plot:
        require("--plot", "matplotlib")
    if is_run:
        return _bench_run(options)
    arguments = {options.what: vars(options)}
    if options.what == "all":
        arguments = {name: vars(options) | changes for name, changes in SMALL.items()}
    benches = {name: _prepared(name, argparse.Namespace(**own)) for name, own in arguments.items()}
    dev, rows = open_device(options.device), []
    print(f"{dev.name} [{dev.info['platform']}]\n{HEAD}")
    for name, measure in benches.items():
        for row in measure(dev):
            rows.append({"bench": name} | row)
            print(line(rows[-1]), flush=True)
    result = {"device": dev.name, "platform": dev.info["platform"], "rows": rows}
    shared.write_json_option(options.json, result)
    if options.plot:
        plot_time_and_error(rows, options.plot, dev.name)


def _bench_run(options):
    """run() for a run's folder."""
    from pp_cl.bench.frontier import HEAD, line, measured
    from pp_cl.bench.plots import plot_frontier
    from pp_cl.run import load

    run = load(options.what, options.device, scene=options.scene)
    result = measured(run, ("psnr", *(name for name in options.metrics or () if name != "psnr")))
    rows, where = result["rows"], f"{run.folder}, {result['views']} views"
    print(f"{where}; {result['device']} [{result['platform']}]\n{HEAD}")
    print("\n".join(map(line, rows)))
    shared.write_json_option(options.json, result)
    if options.plot:
        plot_frontier(rows, options.plot, f"{where}\n{result['device']}")


def _what(text):
    """The type of the subject: a key of OPTIONS, or the folder of a run."""
    if text in OPTIONS or os.path.isdir(text):
        return text
    near = suggestion(text, OPTIONS)
    raise UserError(
        f"{quoted(text)}: {near}choose from {', '.join(OPTIONS)}, or name the folder of a run"
    )


def _prepared(name, options):
    """A bench as a function of the device that yields its rows as they are measured. Raises
    UserError for options that make no sense.
    """
    from pp_cl.bench.conv import bench_conv
    from pp_cl.bench.raster import BLENDS, SCENES, bench_raster
    from pp_cl.bench.training import bench_step
    from pp_cl.bench.unet import bench_unet
    from pp_cl.config import configure, preset

    widths = options.widths or WIDTHS
    if name == "raster":
        scene, blends = options.scene or "grid", options.blend or BLENDS
        if scene not in SCENES:
            raise UserError(f"--scene {scene}: choose from {', '.join(SCENES)}")
        points = options.points or [10_000, 63_000, 250_000, 1_000_000, 4_000_000]
        sizes = options.size or [200, 400, 800]
        return lambda dev: bench_raster(dev, scene, points, sizes, blends=blends)
    if name == "train":
        configs = [
            configure(
                preset("paper"),
                options.scene or "demo",
                [("network.widths", widths, "--widths"), ("points.count", count, "--points")],
            )
            for count in options.points or [preset("paper").points.count]
        ]
        return lambda dev: chain.from_iterable(bench_step(dev, config) for config in configs)
    sizes, bench = options.size or [256], bench_conv if name == "conv" else bench_unet
    blocks = options.blocks or "double"
    return lambda dev: chain.from_iterable(bench(dev, n, widths, blocks=blocks) for n in sizes)
