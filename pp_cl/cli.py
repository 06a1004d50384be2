"""The command line: pp-cl devices | train | eval | compare | bench | tune.

Bad input is one line on stderr and exit status 2.
"""

import argparse
import json
import sys
from pathlib import Path

from pp_cl import __version__
from pp_cl.config import PRESETS, assign, help_lines, load_config, preset, validate
from pp_cl.errors import UserError

METRICS = ("psnr", "ssim", "lpips")


class _Parser(argparse.ArgumentParser):
    """argparse with one-line errors."""

    def error(self, message):
        raise UserError(f"{self.prog}: {message}; see {self.prog} --help")


def main(argv=None):
    """Run a command; returns the exit status."""
    try:
        options = _parser().parse_args(argv)
        return options.run(options) or 0
    except UserError as error:
        print(f"pp-cl: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(
            f"pp-cl: {error.filename or 'file'}: {error.strerror or error}; check the path,"
            " permissions and free space",
            file=sys.stderr,
        )
        return 2
    except MemoryError:
        print(
            "pp-cl: the host has no memory left; lower --points or raise --downscale",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        print(
            "pp-cl: interrupted; the same command takes a training up from its last checkpoint",
            file=sys.stderr,
        )
        return 130


def _parser():
    parser = _Parser(
        prog="pp-cl", description="PlenopticPoints on any OpenCL device.", allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"pp-cl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=_Parser)

    devices = _command(
        commands, "devices", _devices, "list the OpenCL devices and whether they work"
    )
    devices.add_argument("--json", action="store_true", help="print JSON")

    train = _command(
        commands,
        "train",
        _train,
        "learn a scene; the same command resumes an unfinished run",
        epilog="settings (--set), with the tiny preset's values:\n" + "\n".join(help_lines()),
    )
    train.add_argument(
        "scene", metavar="SCENE", help="folder with transforms_train.json, or the word demo"
    )
    train.add_argument("--out", required=True, metavar="RUN", help="folder of the run")
    train.add_argument(
        "--preset",
        choices=PRESETS,
        help=(
            "tiny (default): 200x200, minutes on a CPU; small: 400x400, longer; paper: the paper's"
            " numbers"
        ),
    )
    train.add_argument("--iterations", metavar="N", help="steps of training")
    train.add_argument("--points", metavar="N", help="wanted points on the grid")
    train.add_argument(
        "--downscale", metavar="K", help="reduce the images K times (demo: 2, others: 1)"
    )
    train.add_argument("--seed", metavar="S", help="of everything random (0)")
    train.add_argument(
        "--memory",
        metavar="GIB",
        help="device memory to use; what is not needed caches the hits of repeating views",
    )
    _tolerance_option(train)
    train.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="any other setting, see below",
    )
    _device_option(train)

    evaluate = _command(commands, "eval", _eval, "render a run's views and measure them")
    evaluate.add_argument("run_folder", metavar="RUN", help="folder of the run")
    evaluate.add_argument(
        "--metrics",
        nargs="?",
        const=",".join(METRICS),
        default="psnr,ssim",
        metavar="A,B",
        help="of psnr, ssim, lpips; bare = all three (default psnr,ssim)",
    )
    evaluate.add_argument("--split", default="test", help="train, val or test (default)")
    evaluate.add_argument(
        "--save-images", action="store_true", help="write every view to RUN/eval/images/"
    )
    _tolerance_option(evaluate)
    _device_option(evaluate)

    compare = _command(
        commands, "compare", _compare, "measure one image, or a folder of images, against the truth"
    )
    compare.add_argument("prediction", metavar="PRED")
    compare.add_argument("truth", metavar="TRUTH")
    compare.add_argument(
        "--metrics", nargs="?", const=",".join(METRICS), default="psnr,ssim", metavar="A,B"
    )
    compare.add_argument("--json", metavar="FILE", help="also write the result there")
    _device_option(compare)

    bench = _command(
        commands,
        "bench",
        _bench,
        "time against error of the convolutions, the network, the rasteriser",
    )
    bench.add_argument(
        "what",
        choices=("conv", "unet", "raster"),
        help="conv: every layer of the network; unet: all of it; raster: points",
    )
    bench.add_argument(
        "--size",
        metavar="S",
        help="side of the image in pixels, a multiple of 4 (256; raster: 200,400,800)",
    )
    bench.add_argument(
        "--widths",
        metavar="A,B,C",
        help="conv, unet: channels of the levels (128,256,512: the paper's)",
    )
    bench.add_argument(
        "--scene",
        choices=("grid", "pulsar"),
        help="raster: discs on a grid (default), or Pulsar's spheres",
    )
    bench.add_argument(
        "--points", metavar="N,...", help="raster: numbers of points (10 thousand to 4 million)"
    )
    bench.add_argument(
        "--tau", metavar="T,...", help="raster: weight that a pixel may drop (0,1e-4,1e-3,1e-2)"
    )
    bench.add_argument("--gamma", metavar="G", help="raster: depth sharpness of the blend (0.01)")
    bench.add_argument("--json", metavar="FILE", help="also write the rows there")
    bench.add_argument(
        "--plot", metavar="FILE", help="also draw time against error there (.png, .svg, .pdf)"
    )
    _tolerance_option(bench)
    _device_option(bench)

    tune = _command(
        commands,
        "tune",
        _tune,
        "time the variants of the convolutions on this device, keep the fastest",
    )
    tune.add_argument("--preset", choices=PRESETS, help="whose network and sizes (tiny)")
    tune.add_argument(
        "--widths", metavar="A,B,C", help="channels of the levels, if not the preset's"
    )
    tune.add_argument(
        "--size",
        metavar="S",
        help="side of the image in pixels, a multiple of 4, if not the preset's",
    )
    _tolerance_option(tune)
    _device_option(tune)
    return parser


def _command(commands, name, run, text, **extra):
    parser = commands.add_parser(
        name,
        help=text,
        description=text,
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **extra,
    )
    parser.set_defaults(run=run)
    return parser


def _device_option(parser):
    parser.add_argument(
        "--device", metavar="D", help="index or part of a name, as `pp-cl devices` prints them"
    )


def _tolerance_option(parser):
    parser.add_argument(
        "--tolerance", metavar="E", help="relative L2 error allowed for a convolution (1e-5)"
    )


def _metric_names(text):
    names = tuple(n.strip() for n in text.split(",") if n.strip())
    if not names or set(names) - set(METRICS):
        raise UserError(f"--metrics {text}: choose from {', '.join(METRICS)}")
    return names


def _devices(options):
    from pp_cl.device.device import describe
    from pp_cl.device.discover import MEND, list_devices

    found = list_devices()
    if options.json:
        print(
            json.dumps(
                [{"index": i, **describe(d), "problem": problem} for i, d, problem in found],
                indent=1,
            )
        )
    else:
        for i, d, problem in found:
            info = describe(d)
            print(
                f"{i}  {info['name']}  [{info['platform']}]  "
                f"{info['compute_units']} units, {info['memory_bytes'] / 2**30:.1f} GiB: "
                f"{problem or 'works'}"
            )
    if not any(problem is None for _, _, problem in found):
        raise UserError(f"no working OpenCL device: {MEND}")


def _given_settings(options):
    """[(key, text, origin)] of every setting on the command line."""
    given = []
    for option, key in (
        ("iterations", "train.iterations"),
        ("points", "points.count"),
        ("downscale", "scene.downscale"),
        ("seed", "train.seed"),
        ("memory", "train.memory_gib"),
        ("tolerance", "network.tolerance"),
    ):
        value = getattr(options, option)
        if value is not None:
            given.append((key, value, f"--{option}"))
    for text in options.set:
        key, equals, value = text.partition("=")
        if not equals:
            raise UserError(f"--set {text}: write --set section.key=value")
        given.append((key.strip(), value.strip(), "--set"))
    return given


def _resolve_config(options):
    """Config of the command line; on top of the stored one when the run exists, with which it must
    then agree.
    """
    stored_file = Path(options.out) / "config.json"
    given = _given_settings(options)
    scene = options.scene if options.scene == "demo" else str(Path(options.scene).resolve())
    if stored_file.exists():
        config, stored = load_config(stored_file), load_config(stored_file)
        if options.preset and options.preset != stored.preset:
            raise UserError(
                f"{stored_file}: preset is {stored.preset} there, {options.preset} asked for; use"
                " another --out"
            )
    else:
        config, stored = preset(options.preset or "tiny"), None
        config.scene.downscale = 2 if scene == "demo" else 1
    config.scene.path = scene
    for key, value, origin in given:
        assign(config, key, value, origin)
    validate(config, "settings")
    for note in config.notes:
        print(f"pp-cl: {note}", file=sys.stderr)
    if stored and config != stored:
        raise UserError(
            f"{stored_file}: {_first_difference(config, stored)}; use another --out, or the"
            " settings of the run"
        )
    return config


def _first_difference(asked, stored):
    """`section.key is A there, B asked for` of the first setting that differs."""
    for section in ("scene", "points", "raster", "network", "train"):
        for name, value in vars(getattr(stored, section)).items():
            other = getattr(getattr(asked, section), name)
            if other != value:
                return f"{section}.{name} is {value} there, {other} asked for"
    return "settings differ"


def _train(options):
    from pp_cl.run import train_run

    train_run(Path(options.out), _resolve_config(options), options.device)


def _eval(options):
    from pp_cl.evaluate import evaluate_run

    evaluate_run(
        Path(options.run_folder),
        _metric_names(options.metrics),
        options.split,
        options.save_images,
        options.device,
        options.tolerance,
    )


def _compare(options):
    from pp_cl.device.discover import open_device
    from pp_cl.files.atomic import write_json
    from pp_cl.metrics.compare import compare

    result = compare(
        lambda: open_device(options.device),
        Path(options.prediction),
        Path(options.truth),
        _metric_names(options.metrics),
    )
    if options.json:
        write_json(options.json, result)
    for name, value in result["mean"].items():
        print(f"{name:6s} {value:.4f}")


def _read_tolerance(options):
    """The number of --tolerance, else the default."""
    config = preset("tiny")
    if options.tolerance is not None:
        assign(config, "network.tolerance", options.tolerance, "--tolerance")
        validate(config, "--tolerance")
    return config.network.tolerance


def _bench(options):
    for_raster = {
        name: getattr(options, name) for name in ("scene", "points", "size", "tau", "gamma")
    }
    foreign = [name for name, value in for_raster.items() if value is not None and name != "size"]
    if options.what == "raster":
        from pp_cl.bench.raster import DEFAULTS, run_raster

        for name in ("widths", "tolerance"):
            if getattr(options, name) is not None:
                raise UserError(f"--{name}: the rasteriser has none; leave it out")
        given = {name: value for name, value in for_raster.items() if value is not None}
        run_raster(
            **(DEFAULTS | given),
            json_file=options.json,
            plot_file=options.plot,
            device=options.device,
        )
        return
    if foreign:
        raise UserError(f"--{foreign[0]}: only for pp-cl bench raster; leave it out")
    if options.what == "conv" and options.tolerance is not None:
        raise UserError(
            "--tolerance: bench conv shows every variant; give it to bench unet, whose auto picks"
            " among them"
        )
    _bench_network(options)


def _bench_network(options):
    from pp_cl.bench.conv import bench_conv
    from pp_cl.bench.options import read_shape
    from pp_cl.bench.plots import check_files, plot_time_and_error, save_figure
    from pp_cl.bench.table import HEAD, line
    from pp_cl.bench.unet import bench_unet
    from pp_cl.device.discover import open_device
    from pp_cl.files.atomic import write_json
    from pp_cl.layers.policy import load_policy

    size, widths = read_shape(options.size or "256", options.widths or "128,256,512")
    figure = check_files(options.json, options.plot)
    dev = open_device(options.device)
    print(f"{dev.name} [{dev.info['platform']}]")
    policy = load_policy(dev, _read_tolerance(options))
    print(f"{policy.origin}\n{HEAD}")
    rows = []
    bench = {"conv": bench_conv, "unet": bench_unet}[options.what]
    for row in bench(dev, size, widths, policy):
        rows.append(row)
        print(line(row), flush=True)
    for direction, memory in {r["direction"]: r.get("memory_bytes") for r in rows}.items():
        if memory:
            print(f"the network's memory, {direction}: {memory / 2**20:.0f} MiB")
    if options.json:
        result = {"device": dev.name, "platform": dev.info["platform"], "rows": rows}
        write_json(options.json, result)
    if figure:
        plot_time_and_error(figure, f"{options.what}, {size} x {size}, {dev.name}", rows)
        save_figure(figure, options.plot)


def _tune(options):
    import time

    from pp_cl.bench import tune
    from pp_cl.bench.options import read_shape
    from pp_cl.bench.table import TUNE_HEAD, blocking_line, tune_line
    from pp_cl.device.discover import open_device
    from pp_cl.layers.blocking import CHOICES
    from pp_cl.layers.policy import make_policy
    from pp_cl.layers.variants import shipped_order

    config, tolerance = preset(options.preset or "tiny"), _read_tolerance(options)
    evaluated = tune.EVALUATED[config.preset]
    size, widths = read_shape(
        options.size or str(evaluated), options.widths or ",".join(map(str, config.network.widths))
    )
    training = size if options.size else config.train.crop or evaluated
    dev = open_device(options.device)
    tune.check_cache()
    print(
        f"{dev.name} [{dev.info['platform']}], widths {','.join(map(str, widths))}, "
        f"training at {training}x{training}, evaluation at {size}x{size}"
    )

    def show_blocking(chosen, times):
        shipped = {name: values[0] for name, values in CHOICES[kind].items()}
        for name, ms in times.items():
            print(blocking_line(name, ms, chosen.get(name, shipped[name])))
        print(TUNE_HEAD, flush=True)

    def show_row(case, row):
        policy = make_policy(dev, tolerance, {"tile_shapes": {}, "rows": [row]})
        try:
            chosen = policy.choose(case.shape)
        except UserError:
            chosen = None
        shipped = shipped_order(kind, case.shape)[0]
        print(tune_line(case.name, row, chosen, shipped), flush=True)

    kind = make_policy(dev).device_class
    start = time.perf_counter()
    cases = tune.network_cases(widths, training, size)
    tuning, shipped_ms = tune.run_tune(
        dev, cases, tolerance, on_blocking=show_blocking, on_row=show_row
    )
    print(f"stored in {tune.store(dev, tuning)} ({time.perf_counter() - start:.0f} s)")
    policy = make_policy(dev, tolerance, tuning)
    times = tune.total_times(cases, tuning["rows"], shipped_ms, policy)
    for what, (shipped, tuned) in times.items():
        print(
            f"convolutions of {what}: {shipped:.2f} ms as shipped, {tuned:.2f} ms as tuned, "
            f"{shipped / tuned:.2f} times as fast"
        )
