"""`pp-cl bench`: all benches at sizes that fit a budget of time, for one page about a device."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from pp_cl import __version__
from pp_cl.bench.conv import bench_conv
from pp_cl.bench.raster import bench_raster, growth
from pp_cl.bench.raster_scenes import Case
from pp_cl.bench.training import bench_training
from pp_cl.bench.unet import bench_unet
from pp_cl.device.device import Device
from pp_cl.layers.choice import ConvolutionPolicy

WIDTHS = (32, 64, 128)  # of the presets tiny, small and full
CONV_SIZE = 128
UNET_SIZES = (64, 128, 256, 512)
RASTER_SIZES, RASTER_POINTS = (200, 400, 800), (10_000, 63_000, 250_000, 1_000_000, 4_000_000)
CASES = (Case("alpha", 0.0), Case("alpha", 1e-3), Case("softmax", 0.0))
GAMMA = 0.01  # the last of a training
SHARES = {"conv": 0.25, "unet": 0.2, "raster": 0.2, "training": 0.35}  # of the budget
TRAINED = 0.4  # of its share is the training itself; the rest is the demo, its hull, the kernels
GROWTH = 3  # the next larger case takes so many times as long, or more


def bench_overview(
    dev: Device, policy: ConvolutionPolicy, budget: float, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Everything that the page shows: {"device", "platform", "driver", "version", "convolutions",
    "budget", "seconds", "conv", "unet", "raster", "growth", "training"}.

    budget: seconds, which the least of each bench may exceed. tell: called with a line before each
    bench.
    """
    start, result = time.perf_counter(), {}
    for name, steps, factor in (
        ("conv", layer_steps(dev, policy), 1),
        ("unet", network_steps(dev, policy), GROWTH),
        ("raster", raster_steps(dev), GROWTH),
    ):
        tell(f"{name}: about {budget * SHARES[name]:.0f} s")
        result[name] = within(steps, budget * SHARES[name], factor)
    tell(f"training of the demo: about {budget * SHARES['training']:.0f} s")
    result["growth"] = growth(result["raster"])
    result["training"] = bench_training(dev, budget * SHARES["training"] * TRAINED)
    about = {
        "device": dev.name,
        "platform": dev.info["platform"],
        "driver": dev.info["driver"],
        "version": __version__,
        "convolutions": policy.origin,
        "budget": budget,
        "seconds": time.perf_counter() - start,
    }
    return about | result


def within(steps: Iterator[list[dict]], seconds: float, factor: float) -> list[dict]:
    """The rows of as many steps as fit, one at least. factor: what the next step takes of the time
    of the one before.
    """
    end, rows = time.perf_counter() + seconds, []
    while True:
        start = time.perf_counter()
        step = next(steps, None)
        if step is None:
            return rows
        rows += step
        now = time.perf_counter()
        if now + factor * (now - start) > end:
            return rows


def layer_steps(dev: Device, policy: ConvolutionPolicy) -> Iterator[list[dict]]:
    """The rows of each layer, one direction after the other."""
    rows = []
    for row in bench_conv(dev, CONV_SIZE, WIDTHS, policy):
        key = row["layer"], row["direction"]
        if rows and key != (rows[0]["layer"], rows[0]["direction"]):
            yield rows
            rows = []
        rows.append(row)
    yield rows


def network_steps(dev: Device, policy: ConvolutionPolicy) -> Iterator[list[dict]]:
    """The rows of each size, ascending."""
    for size in UNET_SIZES:
        yield list(bench_unet(dev, size, WIDTHS, policy))


def raster_steps(dev: Device) -> Iterator[list[dict]]:
    """The rows of each number of points and size, about in the order of the time they take."""
    pairs = [(n, size) for n in RASTER_POINTS for size in RASTER_SIZES]
    for n, size in sorted(pairs, key=_work):
        yield list(bench_raster(dev, "grid", [n], [size], cases=list(CASES), gamma=GAMMA))


def _work(pair):
    n, size = pair
    return n + 4 * size * size
