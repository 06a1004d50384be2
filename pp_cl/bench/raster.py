"""`pp-cl bench raster`: time, bytes and error of the rasteriser's stages, by number of points,
image side and blend, on the scenes of raster_scenes.py.

Times are wall clock until the stage's work is done, with both blends in turn.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np

from pp_cl.bench.raster_scenes import SCENES
from pp_cl.bench.timing import interleave
from pp_cl.engine.device.device import Device

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
    for n in points:
        for size in sizes:
            before = dev.reset_peak()
            yield from _rows(dev, SCENES[scene](dev, n, size, gamma), blends, before=before)


def _rows(dev, bench, blends, *, before):
    """Rows of one scene. before: bytes that were in use without it."""
    stages_ms, whole_ms = _time(dev, bench, blends)
    for blend in blends:
        result, stages, times = bench.forward(blend), stages_ms[blend], whole_ms[blend]
        forward = sum(ms for name, ms in stages.items() if name in bench.forward_stages)
        yield {
            "scene": bench.name,
            "points": bench.count,
            "size": bench.size,
            "gamma": bench.gamma,
            "blend": blend,
            "pairs": result.pairs.total,
            "shaded": int(result.weights.shaded.size),
            "forward_ms": forward,
            "backward_ms": sum(stages.values()) - forward,
            "ms": float(np.median(times)),
            "ms_range": [min(times), max(times)],
            "stages_ms": stages,
            "peak_device_bytes": dev.peak_bytes - before,
            "max_err": bench.error(blend, result),
        }


def _time(dev, bench, blends):
    """({blend: {stage: median milliseconds}}, {blend: all its milliseconds}), in turn."""
    seconds = {blend: defaultdict(list) for blend in blends}

    def runner(blend):
        def run():
            with dev.timed_stages() as stages:
                bench.backward(blend, bench.forward(blend))
            for name, values in stages.items():
                seconds[blend][name] += values

        return run

    times = interleave({blend: runner(blend) for blend in blends})
    # the first pass, which builds programs, does not count
    medians = {
        blend: {name: float(np.median(values[1:])) * 1e3 for name, values in stages.items()}
        for blend, stages in seconds.items()
    }
    return medians, times
