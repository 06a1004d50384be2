"""Renderings that are finer than the images of the training, with the network at its own scale."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pp_cl import Camera, RenderedView, Run
from pp_cl.engine import MIN_SIDE

# Of a woven rendering, each way. A run of lego's images of 200 pixels, at 800: the network at 800
# has 28.0 dB, its image of 200 enlarged 27.3, 2 x 2 of these woven 28.8 and 4 x 4 29.0.
MOST_PARTS = 4


def parts(run: Run, camera: Camera) -> int:
    """How many renderings at the training's scale a camera's image is woven of, each way."""
    centre = run.ball[0]

    def fineness(one):
        return min(one.fx, one.fy) / max(float(np.linalg.norm(one.eye - centre)), 1e-30)

    times = fineness(camera) / np.median([fineness(one) for one in run.cameras("train")])
    most = min(MOST_PARTS, min(camera.width, camera.height) // MIN_SIDE)
    return max(1, min(math.ceil(times - 0.25), most))


def render_large(
    run: Run, camera: Camera, *, on_part: Callable[[], object] = lambda: None, **options: Any
) -> RenderedView:
    """run.render(camera, **options), in which the points are as dense as the network knows them:
    an image that is much finer than those of the training is woven of several, each of them shifted
    by a fraction of a pixel. on_part: called before each of these.
    """
    n = parts(run, camera)
    if n == 1:
        on_part()
        return run.render(camera, **options)
    focal = {name: getattr(camera, name) / n for name in ("fx", "fy", "cx", "cy")}
    width, height = -(-camera.width // n), -(-camera.height // n)
    small = replace(camera, **focal, width=width, height=height)
    woven: dict[str, np.ndarray] = {}
    for row, column in itertools.product(range(n), repeat=2):
        on_part()
        shift = [(place + 0.5) / n - 0.5 for place in (column, row)]
        part = run.render(small.shifted(*shift), **options)
        for name, values in vars(part).items():
            if values is not None:
                whole = np.empty((n * height, n * width, *values.shape[2:]), values.dtype)
                woven.setdefault(name, whole)[row::n, column::n] = values
    return RenderedView(**{k: v[: camera.height, : camera.width] for k, v in woven.items()})
