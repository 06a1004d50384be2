"""`pp-cl bench`: all benches at sizes that fit a budget of time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from pp_cl import __version__
from pp_cl.bench import raster, timing
from pp_cl.bench.conv import bench_conv
from pp_cl.bench.training import bench_demo, training_lines
from pp_cl.bench.unet import bench_unet
from pp_cl.device.device import Device

WIDTHS = (32, 64, 128)  # of the presets tiny, small and full
CONV_SIZE = 128
UNET_SIZES = (64, 128, 256, 512)
RASTER_SIZES, RASTER_POINTS = (200, 400, 800), (10_000, 63_000, 250_000, 1_000_000, 4_000_000)
GAMMA = 0.01  # the last of a training
SHARES = {"conv": 0.25, "unet": 0.2, "raster": 0.2, "training": 0.35}  # of the budget
TRAINED = 0.4  # of its share is the training itself; the rest is the demo, its hull, the kernels
GROWTH = 3  # the next larger case takes so many times as long, or more


def bench_overview(dev: Device, budget: float, tell: Callable[[str], None]) -> dict[str, Any]:
    """{"device", "platform", "driver", "version", "budget", "seconds", "conv",
    "unet", "raster", "growth", "training"}: the rows of all benches.

    budget: seconds, which the least of each bench may exceed. tell: called with each line of the
    tables as soon as it is measured.
    """
    start = time.perf_counter()
    result: dict[str, Any] = {}
    for name, steps, factor, columns in (
        ("conv", bench_conv(dev, CONV_SIZE, WIDTHS), 1, timing),
        ("unet", network_steps(dev), GROWTH, timing),
        ("raster", raster_steps(dev), GROWTH, raster),
    ):
        tell(f"\n{name}, about {budget * SHARES[name]:.0f} s\n{columns.HEAD}")
        rows = result[name] = []
        for row in within(steps, budget * SHARES[name], factor):
            rows.append(row)
            tell(columns.line(row))
    result["growth"] = raster.growth(result["raster"])
    for fit in result["growth"]:
        tell(raster.growth_line(fit))
    tell(f"\ntraining of the demo, about {budget * SHARES['training']:.0f} s")
    training = result["training"] = bench_demo(dev, budget * SHARES["training"] * TRAINED)
    for line in training_lines(training):
        tell(line)
    about = {
        "device": dev.name,
        "platform": dev.info["platform"],
        "driver": dev.info["driver"],
        "version": __version__,
        "budget": budget,
        "seconds": time.perf_counter() - start,
    }
    return about | result


def within(steps: Iterator[list[dict]], seconds: float, factor: float) -> Iterator[dict]:
    """The rows of as many steps as fit, one at least. factor: what the next step takes of the time
    of the one before.
    """
    end, start = time.perf_counter() + seconds, time.perf_counter()
    for rows in steps:
        yield from rows
        now = time.perf_counter()
        if now + factor * (now - start) > end:
            return
        start = now


def network_steps(dev: Device) -> Iterator[list[dict]]:
    """The rows of each size, ascending."""
    for size in UNET_SIZES:
        yield list(bench_unet(dev, size, WIDTHS))


def raster_steps(dev: Device) -> Iterator[list[dict]]:
    """The rows of each number of points and size, about in the order of the time they take."""
    pairs = [(n, size) for n in RASTER_POINTS for size in RASTER_SIZES]
    for n, size in sorted(pairs, key=_work):
        yield list(raster.bench_raster(dev, "grid", [n], [size], gamma=GAMMA))


def _work(pair):
    n, size = pair
    return n + 4 * size * size
