"""Renderings finer than the images of the training, with the network at its own scale."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from pp_cl import Camera, RenderedView, Run
from pp_cl.engine import MIN_SIDE
from pp_cl.files import mean_rendered_view

# Most parts of a woven rendering, each way. For a run of the demo at 200 pixels, one rendering of
# 800 has 29.0 dB, 2 x 2 woven ones 30.0, 4 x 4 30.4; after 600 steps of lego 27.1, 27.5 and 27.7.
MOST_PARTS = 4
# Standard deviations, in pixels of the training: of the filter along outlines, and of two that find
# them. A run of the demo's images of 200 pixels has 30.5 dB at 720 with teeth, 30.3 without; a run
# of lego's of 100 pixels has 26.4 and 26.3 at 400.
ALONG, BEFORE, AROUND = 0.4, 0.5, 1.0
TAPS = np.linspace(-2, 2, 9)  # where the filter along outlines samples, in standard deviations
EDGE = 0.25  # change of alpha per pixel of the training from which an outline is fully smoothed
LEAST_EDGE = 0.01


def fineness(run: Run, camera: Camera) -> float:
    """How many pixels of a camera, each way, show what one pixel of the run's images shows at the
    middle of the object.
    """
    centre = run.ball[0]

    def scale(viewer):
        return min(viewer.fx, viewer.fy) / max(float(np.linalg.norm(viewer.eye - centre)), 1e-30)

    return float(scale(camera) / np.median([scale(viewer) for viewer in run.cameras("train")]))


def parts(run: Run, camera: Camera, most: int = MOST_PARTS) -> int:
    """The number of renderings at the training's scale, each way, that make up a camera's woven
    image; at most `most`.
    """
    most = min(most, min(camera.width, camera.height) // MIN_SIDE)
    return max(1, min(math.ceil(fineness(run, camera) - 0.25), most))


def render_large(
    run: Run,
    camera: Camera,
    *,
    most: int = MOST_PARTS,
    samples: int = 1,
    on_part: Callable[[], object] = lambda: None,
    **options: Any,
) -> RenderedView:
    """run.render(camera, samples=samples, **options) with the points as dense as the network knows
    them: an image much finer than those of the training is woven() and gets smooth_outlines().
    most: as in parts(). on_part: called before each part is rendered.
    """
    n, side = parts(run, camera, most), math.isqrt(samples)
    if n == 1:
        on_part()
        return run.render(camera, samples=samples, **options)
    shifts = (np.arange(side) + 0.5) / side - 0.5
    shifted_views = (
        woven(run, camera.shifted(dx, dy), n, on_part, **options) for dy in shifts for dx in shifts
    )
    return smooth_outlines(mean_rendered_view(shifted_views), n)


def woven(
    run: Run, camera: Camera, n: int, on_part: Callable[[], object], **options: Any
) -> RenderedView:
    """Weave an image from n x n renderings at 1/n of its scale, each shifted by another fraction of
    a pixel. Each rendering samples its pixels at one place: four places would be some pixels of the
    image apart and blur it.
    """
    focal = {name: getattr(camera, name) / n for name in ("fx", "fy", "cx", "cy")}
    width, height = -(-camera.width // n), -(-camera.height // n)
    small = replace(camera, **focal, width=width, height=height)
    whole: dict[str, np.ndarray] = {}
    for row, column in itertools.product(range(n), repeat=2):
        on_part()
        shift = [(place + 0.5) / n - 0.5 for place in (column, row)]
        part = run.render(small.shifted(*shift), supersampling=1, **options)
        for name, values in vars(part).items():
            if values is not None:
                empty = np.empty((n * height, n * width, *values.shape[2:]), values.dtype)
                whole.setdefault(name, empty)[row::n, column::n] = values
    return RenderedView(**{k: v[: camera.height, : camera.width] for k, v in whole.items()})


def smooth_outlines(view: RenderedView, n: int) -> RenderedView:
    """The view with alpha averaged along the object's outlines, not across them, over about n
    pixels, the width of one of the training's. At a finer scale the points of an outline show as
    the teeth of a comb.
    """
    alpha = view.alpha
    down, across = np.gradient(gaussian_filter(alpha, BEFORE * n))
    xx, xy, yy = (
        gaussian_filter(product, AROUND * n)
        for product in (across * across, across * down, down * down)
    )
    rows, columns = np.nonzero(np.sqrt(xx + yy) * n > LEAST_EDGE)
    xx, xy, yy = (product[rows, columns] for product in (xx, xy, yy))
    coherence = np.hypot(xx - yy, 2 * xy) / (xx + yy)  # 1 on straight outlines, 0 at corners
    weight = np.minimum(np.sqrt(xx + yy) * n / EDGE, 1) * coherence**4
    angle = (
        np.arctan2(2 * xy, xx - yy) / 2 + np.pi / 2
    )  # the direction in which alpha changes least
    along = np.stack([np.sin(angle), np.cos(angle)])
    shares = np.exp(-(TAPS**2) / 2)
    mean = sum(
        share
        * map_coordinates(alpha, [rows, columns] + ALONG * n * tap * along, order=1, mode="nearest")
        for tap, share in zip(TAPS, shares / shares.sum(), strict=True)
    )
    smooth, colour = alpha.copy(), view.colour.copy()
    smooth[rows, columns] += weight * (mean - alpha[rows, columns])
    # over white, alpha a shows a colour + (1 - a); the colour is that of the surroundings
    near = gaussian_filter(colour - (1 - alpha[..., None]), (1, 1, 0))[rows, columns]
    near /= np.maximum(gaussian_filter(alpha, 1)[rows, columns, None], 1 / 255)
    change = (smooth - alpha)[rows, columns, None]
    colour[rows, columns] += change * (near.clip(0, 1) - 1)
    return replace(view, colour=colour.clip(0, 1), alpha=smooth)
