"""`pp-cl bench`: time and error of convolutions, network, rasteriser and training steps."""

import argparse
from functools import partial
from itertools import chain

from pp_cl.commands import options as shared
from pp_cl.config import CONVOLUTIONS, assign, preset
from pp_cl.errors import UserError

HELP = "time against error of the convolutions, the network, the rasteriser, a training"
# the options that only some benches have
OPTIONS = {
    "all": ("budget", "plot"),
    "conv": ("size", "widths", "blocks", "plot"),
    "unet": ("size", "widths", "blocks", "plot"),
    "raster": ("size", "scene", "points", "blend", "gamma", "plot"),
    "train": ("scene", "points", "set"),
    "model": ("runs", "plot"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add(
        "what",
        nargs="?",
        default="all",
        choices=OPTIONS,
        help="all (default): conv, unet, raster and a training of the demo, at sizes that fit a"
        " budget of time; conv: every layer of the network; unet: all of it; raster: points; train:"
        " a step without the network; model: frames per second against PSNR of a trained run",
    )
    add(
        "--size",
        type=shared.several(shared.side),
        metavar="S",
        help="side of the image in pixels, a multiple of 4 (256; raster: 200,400,800)",
    )
    shared.add_widths(parser, "conv, unet: channels of the levels (128,256,512: the paper's)")
    add("--blocks", choices=CONVOLUTIONS, help="conv, unet: of a level (double)")
    add(
        "--scene",
        metavar="SCENE",
        help="what is timed. raster: made points, grid (discs on a grid, the default) or pulsar"
        " (Pulsar's spheres); train: the folder of a scene, or the word demo (default)",
    )
    add(
        "--points",
        type=shared.several(shared.integer(8, 2**27)),
        metavar="N,...",
        help="raster: numbers of points (10 thousand to 4 million); train: one (4 million)",
    )
    add("--runs", metavar="RUN,...", help="model: folders of runs; the first is reduced as well")
    add(
        "--budget",
        type=_seconds,
        metavar="T",
        help="all: seconds, as 120 or 120s (120)",
    )
    add(
        "--blend",
        type=shared.words(("alpha", "softmax")),
        metavar="B,...",
        help="raster: of alpha,softmax (both)",
    )
    add(
        "--gamma",
        type=shared.number(1e-5, 1),
        metavar="G",
        help="raster: depth sharpness of the blend (0.01)",
    )
    shared.add_set(parser, "train: a setting in place of the paper preset's")
    shared.add_json(parser, OPTIONS)
    add(
        "--plot",
        type=shared.figure_file,
        metavar="FILE",
        help="also draw a picture there (.png, .svg, .pdf)",
    )
    shared.add_device(parser)


def _seconds(text):
    return shared.number(1, 86400)(text.removesuffix("s"))


def run(options: argparse.Namespace) -> None:
    """Measure, print the table, write the files asked for. Raises UserError, before anything is
    measured, for options that make no sense and files that cannot be written.
    """
    from pp_cl.bench.plots import figure_of, save_figure

    _refuse_foreign(options)
    figure = figure_of(options.plot)
    own = {"all": _run_all, "raster": _run_raster, "train": _run_train, "model": _run_model}
    result, draw = own.get(options.what, _run_network)(options)
    shared.write_json_option(options.json, result)
    if figure:
        draw(figure)
        save_figure(figure, options.plot)


def _refuse_foreign(options):
    """Raise UserError for an option of another bench."""
    foreign = {name for names in OPTIONS.values() for name in names} - {*OPTIONS[options.what]}
    shared.refuse(options, foreign, f"bench {options.what} has no such option")


# ---- each bench: (what --json writes, draws it into a figure)


def _run_all(options):
    from pp_cl.bench.overview import bench_overview
    from pp_cl.bench.plots import plot_overview

    dev = _open_device(options)
    result = bench_overview(dev, options.budget or 120, partial(print, flush=True))
    print(f"{result['seconds']:.0f} s")

    def draw(figure):
        figure.suptitle(dev.name)
        plot_overview(figure, result)

    return result, draw


def _run_raster(options):
    from pp_cl.bench.plots import plot_growth
    from pp_cl.bench.raster import BLENDS, HEAD, bench_raster, growth, growth_line, line
    from pp_cl.bench.raster_scenes import SCENES

    scene = options.scene or "grid"
    if scene not in SCENES:
        raise UserError(f"--scene {scene}: choose from {', '.join(SCENES)}")
    points = options.points or [10_000, 63_000, 250_000, 1_000_000, 4_000_000]
    sizes, blends = options.size or [200, 400, 800], options.blend or BLENDS
    gamma = options.gamma or 0.01  # the last one of a training, the sharpest
    dev = _open_device(options)
    found = bench_raster(dev, scene, points, sizes, blends=blends, gamma=gamma)
    rows = _print_rows(HEAD, line, found)
    fits = growth(rows)
    for fit in fits:
        print(growth_line(fit))
    title = f"raster, {scene}, gamma {gamma:g}, {dev.name}"
    return _result(dev, rows) | {"growth": fits}, partial(_draw, plot_growth, rows, title)


def _run_train(options):
    from pp_cl.bench.training import bench_step
    from pp_cl.config import configure

    config = configure(preset("paper"), options.scene or "demo", options.set)
    if options.points:
        assign(config, "points.count", _one(options, "points"), "--points")
    dev = _open_device(options)
    row = bench_step(dev, config)
    print(
        f"{row['points']} points, {row['pairs']} hits in a view, {row['shaded']:.0%} shaded,"
        f" {row['peak_device_bytes'] / 2**30:.2f} GiB at the peak"
    )
    for name, ms in row["stages_ms"].items():
        print(f"  {name:10s} {ms:9.2f} ms")
    print(f"forward {row['forward_ms']:.2f} ms, backward and update {row['backward_ms']:.2f} ms")
    return _result(dev, [row]), None


def _run_model(options):
    from pp_cl.bench.model import HEAD, bench_models, line
    from pp_cl.bench.plots import plot_models
    from pp_cl.run import load_run

    if not options.runs:
        raise UserError("--runs: missing; name the folder of a trained run")
    dev = _open_device(options)
    runs = [load_run(dev, folder) for folder in options.runs.split(",")]
    rows = _print_rows(HEAD, line, bench_models(runs))
    return _result(dev, rows), partial(_draw, plot_models, rows, f"{runs[0].folder}, {dev.name}")


def _run_network(options):
    from pp_cl.bench.conv import bench_conv
    from pp_cl.bench.plots import plot_time_and_error
    from pp_cl.bench.timing import HEAD, line
    from pp_cl.bench.unet import bench_unet

    size = _one(options, "size") if options.size else 256
    widths, blocks = options.widths or (128, 256, 512), options.blocks or "double"
    dev = _open_device(options)
    if options.what == "conv":
        found = chain.from_iterable(bench_conv(dev, size, widths, blocks=blocks))
    else:
        found = bench_unet(dev, size, widths, blocks=blocks)
    rows = _print_rows(HEAD, line, found)
    for direction, memory in {r["direction"]: r.get("memory_bytes") for r in rows}.items():
        if memory:
            print(f"the network's memory, {direction}: {memory / 2**20:.0f} MiB")
    title = f"{options.what}, {size} x {size}, {dev.name}"
    return _result(dev, rows), partial(_draw, plot_time_and_error, rows, title)


def _print_rows(head, line, found):
    """The rows, each printed as soon as it is measured."""
    print(head)
    rows = []
    for row in found:
        rows.append(row)
        print(line(row), flush=True)
    return rows


def _draw(plot, rows, title, figure):
    plot(figure.add_subplot(title=title), rows)


def _result(dev, rows):
    return {"device": dev.name, "platform": dev.info["platform"], "rows": rows}


def _one(options, name):
    """The number of an option that only bench raster takes several of."""
    numbers = getattr(options, name)
    if len(numbers) > 1:
        text = ",".join(map(str, numbers))
        raise UserError(f"--{name} {text}: write one number for bench {options.what}")
    return numbers[0]


def _open_device(options):
    """The device asked for, named on the first line."""
    from pp_cl.device.discover import open_device

    dev = open_device(options.device)
    print(f"{dev.name} [{dev.info['platform']}]")
    return dev
