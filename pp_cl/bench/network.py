"""`pp-cl bench`: time against error of the variants of the convolutions, layer by layer and as a
network.

Times are wall clock, launches included, of runs in turn: every variant and the loop of
cl/bench/peak.cl once a round, so that a machine that slows down slows all of them. Errors are
against float64 (reference.py): of a layer at SAMPLES pixels, for its weights at SAMPLE_CHANNELS x
SAMPLE_CHANNELS channels and every tap; of the network over the whole image, at most CHECK_SIZE wide
and high, which is the upper left part of a larger one, taken as an image of its own.
"""

import time
from pathlib import Path

import numpy as np

from pp_cl.bench.layer import DIRECTIONS, Layer
from pp_cl.bench.peak import Peak
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file, write_json
from pp_cl.layers.conv import unpack_weights
from pp_cl.layers.resample import affine
from pp_cl.layers.tuning import adopt_stored
from pp_cl.layers.variants import VARIANTS, offered
from pp_cl.network.unet import UNet, unet_steps
from pp_cl.reference import network as reference

NETWORK_VARIANTS = ("auto", *VARIANTS)
CHANNELS_IN, CHANNELS_OUT = 16, 3
CHECK_SIZE = 128  # float64 takes seconds for each variant of the paper's network at this size

# Rounds of a measurement: at least so many, then until the time is up or the most are done.
LEAST_ROUNDS, MOST_ROUNDS, SECONDS = 5, 50, 1.5


def interleave(runs, rounds=None, pause=0.0):
    """{name: [milliseconds]} of functions that return when their work is done, called in turn,
    after one round unmeasured.

    rounds: as many; None = LEAST_ROUNDS to MOST_ROUNDS, within SECONDS. pause: seconds before each
    call, for threads of the one before it that still wait for work to come.
    """
    times = {name: [] for name in runs}
    for run in runs.values():
        run()
    start, done = time.perf_counter(), 0
    while done < (rounds or LEAST_ROUNDS) or (
        not rounds and done < MOST_ROUNDS and time.perf_counter() - start < SECONDS
    ):
        for name, run in runs.items():
            time.sleep(pause)
            before = time.perf_counter()
            run()
            times[name].append((time.perf_counter() - before) * 1e3)
        done += 1
    return times


def errors(actual, expected):
    """(relative L2 error, largest absolute difference). Raises FloatingPointError if a value is NaN
    or Inf.
    """
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    if not np.isfinite(actual).all():
        raise FloatingPointError("a result holds NaN or Inf")
    difference = actual - expected
    return (
        float(
            np.linalg.norm(difference) / max(np.linalg.norm(expected), np.finfo(np.float32).tiny)
        ),
        float(np.abs(difference).max()),
    )


def flops_of(step, channels, height, width):
    """Floating-point operations of one convolution of the network, counted as a direct one, a
    multiply-add as two.
    """
    k, ci = int(step.kind[-1]), sum(channels[name] for name in step.inputs)
    return 2 * k * k * ci * step.channels * (height >> step.level) * (width >> step.level)


def bench_conv(dev, size, widths):
    """Rows of every distinct convolution of the network at size x size: forward, input gradient,
    weight gradient.
    """
    peak, rows, seen = Peak(dev), [], set()
    steps, channels = network_shape(widths)
    for step in (s for s in steps if s.kind.startswith("conv")):
        sources = tuple(channels[name] for name in step.inputs)
        side = size >> step.level
        key = (step.kind, side, sources, step.channels)
        if key in seen:
            continue
        seen.add(key)
        layer = Layer(dev, int(step.kind[-1]), side, sources, step.channels)
        about = {"layer": step.name, "shape": [side, side, sum(sources), step.channels, layer.k]}
        for direction in DIRECTIONS:
            runs = {variant: layer.runner(variant, direction) for variant in layer.variants}
            found = {
                variant: errors(*layer.result(variant, direction)) for variant in layer.variants
            }
            rows += _rows(
                about | {"direction": direction},
                runs,
                found,
                flops_of(step, channels, size, size),
                peak,
            )
    return rows


def bench_unet(dev, size, widths):
    """Rows of the whole network at size x size: forward, and train = forward and backward to the
    input and the weights.

    The errors of train are those of the gradient (input's, or a weight's or bias's) where they are
    largest.
    """
    peak, rng = Peak(dev), np.random.default_rng(0)
    steps, channels = network_shape(widths)
    x = np.maximum(rng.normal(size=(size, size, CHANNELS_IN)), 0).astype(np.float32)
    grad_image = rng.normal(size=(size, size, CHANNELS_OUT)).astype(np.float32)
    # one for all, so that large images fit
    net, names = make_network(dev, widths, "auto"), ("auto", *offered(dev))
    found = _network_errors(
        dev, net, names, x[:CHECK_SIZE, :CHECK_SIZE], grad_image[:CHECK_SIZE, :CHECK_SIZE]
    )
    device_x, device_grad = dev.upload(x), dev.upload(grad_image)
    flops = sum(
        flops_of(step, channels, size, size) for step in steps if step.kind.startswith("conv")
    )
    rows = []
    for direction, factor, run in (("forward", 1, forward_runner), ("train", 3, train_runner)):
        net.variant = "auto"
        memory = sum(row[2] for row in net.memory_plan(size, size, direction == "train"))
        print(f"the network's memory, {direction}: {memory / 2**20:.0f} MiB")
        runs = {
            variant: _as_variant(net, variant, run(dev, net, device_x, device_grad))
            for variant in names
        }
        about = {
            "layer": "network",
            "shape": [size, size, CHANNELS_IN, *widths, CHANNELS_OUT],
            "direction": direction,
            "memory_bytes": memory,
        }
        rows += _rows(
            about,
            runs,
            {variant: found[variant][direction] for variant in names},
            factor * flops,
            peak,
        )
    return rows


def _as_variant(net, variant, run):
    """`run` of the network, as a function that has it compute by a variant."""

    def changed():
        net.variant = variant
        run()

    return changed


def make_network(dev, widths, variant):
    """The network of a variant; the parameters are those of any other.

    The weights are uniform in +-sqrt(6 / (CI K K)) (He et al. 2015), so that values keep their size
    through the layers as they do in a trained network. With UNet's own initial weights they fade,
    and the error of an image that is 0.5 and little else says nothing.
    """
    net = UNet(dev, widths, CHANNELS_IN, CHANNELS_OUT, variant=variant)
    for name, parameter in net.parameters.items():
        if name.endswith(".weight"):
            affine(dev, np.sqrt(6), 0.0, parameter, parameter)
    return net


def forward_runner(dev, net, x, grad_image):
    """A function that makes an image, as evaluation does, and waits for it."""

    def run():
        net.forward(x, training=False)
        dev.finish()

    return run


def train_runner(dev, net, x, grad_image):
    """A function that makes an image and then all gradients, and waits for them."""

    def run():
        net.forward(x)
        net.backward(grad_image)
        dev.finish()

    return run


def plain_parameters(net, arrays):
    """{name: (CO, CI, K, K) or (CO,) numpy array} of a network's parameters or gradients."""
    plain = {}
    for name, array in arrays.items():
        values, co = array.get(), net.channels[name.rsplit(".", 1)[0]]
        plain[name] = unpack_weights(values, co) if values.ndim == 5 else values[:co]
    return plain


def network_shape(widths):
    """(steps, {name of a step or "x": its channels}) of the network."""
    steps = unet_steps(widths, CHANNELS_OUT)
    return steps, {"x": CHANNELS_IN} | {s.name: s.channels for s in steps}


def _network_errors(dev, net, names, x, grad_image):
    """{variant: {"forward": errors, "train": errors}}."""
    found, device_x, parameters = {}, dev.upload(x), plain_parameters(net, net.parameters)
    outputs = reference.network(net.steps, parameters, x)
    for variant in names:
        net.variant = variant
        image = net.forward(device_x).get()
        active = {s.name: net.output(s.name).get() > 0 for s in net.steps if s.kind == "conv3"}
        actual = {"x": net.backward(dev.upload(grad_image)).get()} | plain_parameters(
            net, net.gradients
        )
        expected = reference.network_gradients(net.steps, parameters, outputs, active, grad_image)
        found[variant] = {
            "forward": errors(image, outputs["image"]),
            "train": max(errors(actual[name], expected[name]) for name in expected),
        }
    return found


def _rows(about, runs, found, flops, peak):
    """A row for each run; found: {variant: (relative L2, maximum)}."""
    times = interleave({**runs, "peak": peak.run})
    peak_gflops = peak.flops / np.median(times["peak"]) * 1e-6
    rows = []
    for variant in runs:
        low, ms, high = np.percentile(times[variant], (25, 50, 75))
        gflops = flops / ms * 1e-6
        rows.append(
            {"variant": variant}
            | about
            | {
                "ms": float(ms),
                "ms_quartiles": [float(low), float(high)],
                "runs": len(times[variant]),
                "gflops": float(gflops),
                "peak_gflops": float(peak_gflops),
                "peak_share": float(gflops / peak_gflops),
                "rel_l2": found[variant][0],
                "max_err": found[variant][1],
            }
        )
        print(line(rows[-1]), flush=True)
    return rows


COLUMNS = "{:8} {:26} {:9} {:14} {:>9} {:>8} {:>5} {:>8} {:>8}".format
HEAD = COLUMNS("layer", "shape", "direction", "variant", "ms", "GFLOP/s", "peak", "rel. L2", "max")


def line(row):
    """One line of the printed table."""
    return COLUMNS(
        row["layer"],
        "x".join(map(str, row["shape"])),
        row["direction"],
        row["variant"],
        f"{row['ms']:.3f}",
        f"{row['gflops']:.1f}",
        f"{row['peak_share']:.0%}",
        f"{row['rel_l2']:.1e}",
        f"{row['max_err']:.1e}",
    )


BENCHES = {"conv": bench_conv, "unet": bench_unet}


def run_bench(what, size, widths, tolerance=1e-5, *, json_file=None, plot_file=None, device=None):
    """Measure, print the table, write the files asked for. what: a key of BENCHES; size: side of
    the image in pixels, a multiple of 4; widths: channels of the three levels; tolerance: relative
    L2 error allowed for a convolution of the variant auto.

    Raises UserError, before anything is measured, for files that cannot be written.
    """
    figure = check_files(json_file, plot_file)
    dev = open_device(device)
    print(f"{dev.name} [{dev.info['platform']}]")
    adopt_stored(dev, tolerance)
    print(HEAD)
    rows = BENCHES[what](dev, size, widths)
    if json_file:
        write_json(json_file, {"device": dev.name, "platform": dev.info["platform"], "rows": rows})
    if figure:
        _plot(figure, plot_file, f"{what}, {size} x {size}, {dev.name}", rows)


def check_files(json_file, plot_file):
    """A figure for the plot, None where there is none. Raises UserError if a file cannot be
    written.
    """
    for option, file in (("--json", json_file), ("--plot", plot_file)):
        if file and not Path(file).resolve().parent.is_dir():
            raise UserError(f"{option} {file}: no such folder; make it first")
    return _figure(plot_file) if plot_file else None


def _figure(path):
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UserError(
            f"--plot {path}: needs matplotlib; install it with `pip install 'pp-cl[plot]'`"
        ) from None
    figure, suffix = Figure(figsize=(8, 6), layout="constrained"), Path(path).suffix[1:].lower()
    if suffix not in figure.canvas.get_supported_filetypes():
        raise UserError(f"--plot {path}: name a .png, .svg or .pdf file")
    return figure


def _plot(figure, path, title, rows):
    """Time against error, both logarithmic: a colour for each variant, a marker for each
    direction.
    """
    axes = figure.add_subplot(
        xscale="log", yscale="log", xlabel="milliseconds", ylabel="relative L2 error", title=title
    )
    directions, variants = (
        list(dict.fromkeys(row[key] for row in rows)) for key in ("direction", "variant")
    )
    for d, direction in enumerate(directions):
        for v, variant in enumerate(variants):
            some = [
                row for row in rows if row["direction"] == direction and row["variant"] == variant
            ]
            # an error of 0 has no logarithm: draw it far below float32's
            axes.plot(
                [row["ms"] for row in some],
                [max(row["rel_l2"], 1e-9) for row in some],
                "os^"[d],
                color=f"C{v}",
                label=f"{variant}, {direction}",
            )
    save_figure(figure, path)


def save_figure(figure, path):
    """Write a figure whose axes are drawn, with a grid and a legend."""
    for axes in figure.axes:
        axes.grid(True, which="both", alpha=0.3)
        axes.legend(fontsize="small")
    with atomic_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower())
