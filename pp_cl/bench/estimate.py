"""What the stages of a training step must at least take on a device, from the bytes that they move
and the multiply-adds that they do: nothing is measured.

A stage takes the longer of the two at the device's full bandwidth and rate, and 5 us for each
launch. No kernel reaches both peaks; bytes that are read twice and come out of a cache the second
time count once. What is not due in every step is left out: smoothing, averages, pruning, LPIPS.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from pp_cl import __version__
from pp_cl.bench.peak import CopyBandwidth, PeakFlops
from pp_cl.bench.timing import interleave
from pp_cl.config import Config
from pp_cl.device.buffers import table_bytes
from pp_cl.device.device import Device
from pp_cl.device.scan import BLOCK_ON_GPU
from pp_cl.layers.conv_direct import partial_floats
from pp_cl.network.layers import Layer, multiplications, parameter_table, unet_layers
from pp_cl.raster.blend import BLENDS, Blend
from pp_cl.raster.pairs import LONG_LIST, PairBuilder
from pp_cl.raster.point_cloud import PointCloud
from pp_cl.raster.project import Projection
from pp_cl.raster.sh import sh_blocks
from pp_cl.training.loss import TAPS, Loss

LAUNCH_SECONDS = 5e-6
ROW = 64  # bytes of 16 channels
GPU_LOSS_VALUES = 4  # lanes_of_loss() on GPUs
IMAGE = 2 * 4 * 3  # bytes of a pixel of an image that is read and written
ADAM = 12  # multiply-adds of a value


class Work(NamedTuple):
    """What a stage does."""

    bytes: float = 0
    multiply_adds: float = 0
    launches: int = 0


class Card(NamedTuple):
    """A device's peaks: bytes per second, read or written, and floating-point operations per
    second, of which a multiply-add is two.
    """

    bandwidth: float
    flops: float

    def seconds(self, work: Work) -> float:
        """The least that the work takes."""
        return (
            max(work.bytes / self.bandwidth, 2 * work.multiply_adds / self.flops)
            + work.launches * LAUNCH_SECONDS
        )


@dataclass(frozen=True)
class Counts:
    """What a step works on. pairs: of the view. shaded: its points. height, width: pixels of the
    step, multiples of 4. computed: share of the network's multiplications that are done.
    """

    points: int
    pairs: int
    shaded: int
    height: int
    width: int
    computed: float = 1.0

    @property
    def pixels(self) -> int:
        """Of the step."""
        return self.height * self.width


def step_work(config: Config, counts: Counts) -> dict[str, Work]:
    """{stage: Work} of one training step on a GPU, in order; the pairs are built, not kept."""
    layers = network_layers(config)
    # features and colours, or their gradients, of which one is written
    residual = Work(counts.pixels * (ROW + IMAGE), 3 * counts.pixels, 1)
    residual = residual if config.network.residual else Work()
    return {
        "target": Work(counts.pixels * (4 + 12 + 4), 0, 2),
        **_raster(config, counts),
        "network": _added(_forward(layers, counts), residual),
        "loss": _loss(config, counts),
        "network backward": _added(_backward(layers, counts), residual),
        "backward": _gradients(config, counts),
        "update": _update(config, layers, counts),
        # a weight and a role of each pair; two numbers a point, read and written
        "peaks": Work(9 * counts.pairs + 20 * counts.points, counts.pairs, 1),
    }


def _added(*works):
    return Work(*map(sum, zip(*works, strict=True)))


def network_layers(config: Config) -> list[Layer]:
    """Of the run's network."""
    net = config.network
    return unet_layers(net.widths, blocks=net.blocks, channels=net.channel_numbers)


def _raster(config, counts):
    """The stages from projection to blending."""
    n, p, s, raster = counts.points, counts.pairs, counts.shaded, config.raster
    coefficients = sum(block.count for block in sh_blocks(config.points.sh_degree))
    projected = table_bytes(Projection.table(n))
    pairs = PairBuilder.table(n, counts.pixels, p)
    keys = table_bytes({name: pairs[name] for name in ("pair_key", "pair_scratch")})
    drops = raster.early_stop > 0 or raster.tau > 0
    blend = BLENDS[raster.blend]
    weights = table_bytes(blend.table(n, p, drops or raster.max_tracked > 0))
    weights += table_bytes(blend.own_table(counts.pixels, 0))
    return {
        # hits are counted, then found again
        "project": Work(4 * n + projected, 16 * (2 * n + p), 1),
        # every array is written once and read once, the keys sorted in two passes
        "pairs": Work(
            projected + 2 * (table_bytes(pairs) + keys),
            16 * (n + p),
            4 + 2 * (p > LONG_LIST) + _scans(n) + _scans(counts.pixels),
        ),
        # of each pair its key, its closeness, the opacity of its point, and its entry
        "weights": Work(weights + 28 * p + 8 * counts.pixels, 20 * p, 2 + _lists(n)),
        "shade": Work(s * (4 + 16 + ROW * (coefficients + 1)), s * 16 * coefficients, 1),
        "blend": Work(p * (8 + ROW) + counts.pixels * (4 + ROW), 16 * p, 1),
    }


def _scans(n):
    """Launches of exclusive_scan() of n values on a GPU."""
    return 1 if n <= BLOCK_ON_GPU else 2 + _scans(-(-n // BLOCK_ON_GPU))


def _lists(n):
    """Launches of nonzero() of n values on a GPU."""
    return 2 + _scans(-(-n // BLOCK_ON_GPU))


def _maps(layers, counts):
    """(layer, bytes of its inputs, bytes of its output), of what is computed of them."""
    sizes = {"x": counts.computed * ROW * counts.pixels}
    for layer in layers:
        pixels = counts.pixels >> 2 * layer.level
        sizes[layer.name] = counts.computed * 4 * layer.channels * pixels
        yield layer, sum(sizes[name] for name in layer.inputs), sizes[layer.name]


def _multiply_adds(layers, counts):
    """Of one direction of the network's convolutions."""
    return counts.computed * multiplications(layers, counts.height, counts.width)


def _forward(layers, counts):
    """Each layer reads its inputs and parameters and writes its output; the image is scaled."""
    moved = table_bytes(parameter_table(layers)) + IMAGE * counts.pixels
    moved += sum(inputs + output for _, inputs, output in _maps(layers, counts))
    return Work(moved, _multiply_adds(layers, counts), len(layers) + 1)


def _backward(layers, counts):
    """The gradients of inputs and weights take as many multiply-adds as the forward pass each."""
    moved, launches = IMAGE * counts.pixels, 1
    for layer, inputs, output in _maps(layers, counts):
        if layer.kind != "conv":
            moved += 2 * inputs + output
            launches += 1
            continue
        # of inputs: masked and written, and read for the weights; of weights: flipped, and used
        parameters = parameter_table([layer])
        shape, _ = parameters[layer.name + ".weight"]
        partial = 4 * partial_floats(counts.height >> layer.level, shape)
        moved += 3 * inputs + 2 * output + 4 * table_bytes(parameters) + 2 * partial
        launches += 3 * len(layer.inputs) + 2
    return Work(moved, 2 * _multiply_adds(layers, counts), launches)


def _loss(config, counts):
    """Each scratch array is written once and read once, the images twice. The windows are sums
    along columns, then rows, of five moments, of four, and of three slopes both ways.
    """
    train, shape = config.train, (counts.height, counts.width, 3)
    scratch = table_bytes(Loss.table(shape, shape, train.ssim_weight, GPU_LOSS_VALUES))
    masked = train.mask_weight > 0
    moved = 2 * scratch + 4 * 2 * 12 * counts.pixels + masked * 3 * 4 * counts.pixels
    return Work(moved, 3 * counts.pixels * TAPS * (5 + 4 + 2 * 3), 6 + 2 * masked)


def _gradients(config, counts):
    """Of the points' features and opacities: a row of G and a weight for each pair."""
    rest = table_bytes(BLENDS[config.raster.blend].own_table(counts.pixels, counts.pairs))
    moved = table_bytes(Blend.table(counts.points)) + ROW * counts.shaded
    moved += counts.pairs * (8 + 4 + ROW) + 2 * ROW * counts.pixels + 2 * rest
    return Work(moved, 3 * 16 * counts.pairs, 2)


def _update(config, layers, counts):
    """Parameters and moments are read and written, gradients read; of the SH those of the shaded
    points alone, whose gradients and last steps are read twice.
    """
    n, s, blocks = counts.points, counts.shaded, sh_blocks(config.points.sh_degree)
    point = PointCloud.table(1, blocks)
    sh = table_bytes({b.name: point[b.name] for b in blocks})
    moved = s * (2 * sh + 2 * ROW + 2 * (ROW + 4) + 3 * 4) + 4 * n * (2 * 3 + 1)
    parameters = table_bytes(parameter_table(layers))
    coefficients = sum(block.count for block in blocks)
    adds = 16 * s * (coefficients + ADAM) + ADAM * (n + parameters / 4)
    return Work(moved + 7 * parameters, adds, 3 + len(parameter_table(layers)))


def measured_card(dev: Device) -> Card:
    """The peaks that the device reaches now: of a copy, and of multiply-adds in registers."""
    copy, peak = CopyBandwidth(dev), PeakFlops(dev)
    ms = {name: min(t) for name, t in interleave({"copy": copy.run, "peak": peak.run}).items()}
    return Card(copy.bytes / ms["copy"] * 1e3, peak.flops / ms["peak"] * 1e3)


def report(
    dev: Device, config: Config, counts: Counts, stages_ms: Mapping[str, float]
) -> list[str]:
    """Lines of Markdown: the device, and the measured time of each stage beside its estimate."""
    card, work = measured_card(dev), step_work(config, counts)
    info = dev.info
    lines = [
        f"pp-cl {__version__}, {dev.name} [{info['platform']}, {info['driver']}],"
        f" {info['compute_units']} units, {info['memory_bytes'] / 2**30:.1f} GiB; a copy moves"
        f" {card.bandwidth / 1e9:.0f} GB/s, multiply-adds in registers reach"
        f" {card.flops / 1e9:.0f} GFLOP/s.",
        f"Preset {config.preset}, {counts.points} points, {counts.pairs} hits and"
        f" {counts.shaded} shaded points in {counts.width}x{counts.height} pixels.",
        "",
        "| stage | measured, ms | estimated from these rates, ms |",
        "| --- | --- | --- |",
    ]
    for stage, ms in stages_ms.items():
        least = f"{card.seconds(work[stage]) * 1e3:.3g}" if stage in work else ""
        lines.append(f"| {stage} | {ms:.3g} | {least} |")
    return lines
