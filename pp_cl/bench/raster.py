"""`pp-cl bench raster`: time, bytes and error of the rasteriser's stages, by number of points,
image side and blend.

Scenes: `grid`, a ball full of points on a grid, as discs with spherical harmonics, seen like the
objects of the papers' scenes; `pulsar`, spheres of radius 0.0015 in a cube of side 1 at a depth of
1 to 2, with features of their own.

The error is the largest against float64 at some pixels, in shares of the features' range over the
points seen and the background.

Times are wall clock until the stage's work is done, in turn: all stages of both blends and the copy
of cl/bench/peak.cl once a round.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pp_cl.bench.raster_scenes import SCENES
from pp_cl.bench.timing import CopyBandwidth, interleave
from pp_cl.device.device import Device

BLENDS = ("alpha", "softmax")


def bench_raster(
    dev: Device,
    scene: str,
    points: list[int],
    sizes: list[int],
    *,
    blends: Sequence[str] = BLENDS,
    gamma: float,
) -> Iterator[dict]:
    """Yield a row for every number of points, side and blend. scene: a key of SCENES."""
    copy = CopyBandwidth(dev)
    for n in points:
        for size in sizes:
            before = dev.reset_peak()
            yield from _rows(
                dev, SCENES[scene](dev, n, size, gamma), blends, copy=copy, before=before
            )


def _rows(dev, bench, blends, *, copy, before):
    """Rows of one scene."""
    stages_ms, whole_ms = _time(dev, bench, blends, copy)
    copied = copy.bytes / np.median(whole_ms["copy"]) * 1e-6
    # both rasterise the scene when they are first read: not inside the loop, which does so too
    _ = bench.feature_range, bench.covered_pixels
    for blend in blends:
        result, stages = bench.forward(blend), stages_ms[blend]
        features, moved = result.features.get(), bench.moved_bytes(blend, result)
        forward = sum(ms for name, ms in stages.items() if name in bench.forward_stages)
        backward = sum(stages.values()) - forward
        gbs = moved / (forward + backward) * 1e-6
        yield {
            "scene": bench.name,
            "points": bench.count,
            "size": bench.size,
            "gamma": bench.gamma,
            "blend": blend,
            "pairs": result.pairs.total,
            "shaded": int(result.weights.shaded.size),
            "forward_ms": forward,
            "backward_ms": backward,
            "ms": float(np.median(whole_ms[blend])),
            "ms_range": [min(whole_ms[blend]), max(whole_ms[blend])],
            "stages_ms": stages,
            "copy_share": float(gbs / copied),
            "peak_device_bytes": dev.peak_bytes - before,
            "max_err": bench.error(blend, features),
        }


def _time(dev, bench, blends, copy):
    """({blend: {stage: median milliseconds}}, {blend or "copy": all its milliseconds}), all in
    turn.
    """
    seconds = {blend: defaultdict(list) for blend in blends}

    def runner(blend):
        def run():
            with dev.timed_stages() as stages:
                bench.backward(blend, bench.forward(blend))
            for name, values in stages.items():
                seconds[blend][name] += values

        return run

    times = interleave({blend: runner(blend) for blend in blends} | {"copy": copy.run})
    # the first pass, which builds programs, does not count
    medians = {
        blend: {name: float(np.median(values[1:])) * 1e3 for name, values in stages.items()}
        for blend, stages in seconds.items()
    }
    return medians, times


COLUMNS = "{:7} {:>8} {:>5} {:7} {:>9} {:>9} {:>9} {:>5} {:>8}  {}".format
WORDS = "scene points side blend shaded forward backward copy max-err stages"
HEAD = COLUMNS(*WORDS.split())


def line(row: dict) -> str:
    """One line of the printed table, also of a step of bench_step(); times in milliseconds."""
    stages = ", ".join(f"{name} {ms:.2f}" for name, ms in row["stages_ms"].items())
    return COLUMNS(
        Path(row["scene"]).name,
        row["points"],
        row["size"],
        row["blend"],
        row["shaded"],
        f"{row['forward_ms']:.2f}",
        f"{row['backward_ms']:.2f}",
        f"{row['copy_share']:.0%}" if "copy_share" in row else "",
        f"{row['max_err']:.1e}" if "max_err" in row else "",
        stages,
    )
