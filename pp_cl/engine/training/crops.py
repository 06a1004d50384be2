"""The crops of views that a training learns from, one a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.settings import TrainConfig

BOX_MARGIN = 8  # pixels around the object from which crops are drawn
CROP_LOSS = 0.25  # of the crop's side for every halving of the images
END_SHARE = 0.25  # least share of the crops that show one end of the object
BETWEEN = 0.125  # pixels by which images at their own size are shifted: farther would blur them


class Crop(NamedTuple):
    """A part of a view. box: (x0, y0, width, height), pixels of its reduced image; jitter: stored
    pixels by which the reduced image starts further right and down; camera: of the part.
    """

    view_index: int
    view: View
    box: tuple[int, int, int, int]
    jitter: tuple[float, float]
    camera: Camera


class Crops:
    """Draws crops of views whose images are halved a number of times. Every choice is a function of
    (train.seed, step). Raises UserError if the halved images are too small.

    views: the halved views. side: side of a crop in pixels; 0: whole images. halvings: how many
    times the images are halved.
    """

    def __init__(self, views: Sequence[View], train: TrainConfig, halvings: int):
        try:
            self.views = [view.reduced(view.downscale * 2**halvings) for view in views]
        except UserError as error:
            raise UserError(
                f"train.refine_at halves the images {halvings} times; use fewer of them ({error})"
            ) from None
        self.halvings = halvings
        self.side = crop_side(train.crop, halvings)
        self._seed, self._jitters = train.seed, train.pixel_jitter
        self._epoch, self._order = -1, [0]  # of views, in an epoch
        self._boxes = [view.object_bounds(BOX_MARGIN) for view in self.views]

    def draw(self, step: int) -> Crop:
        """The crop of a step: of views in a new random order every epoch, around the object."""
        rng, n = np.random.default_rng((self._seed, step)), len(self.views)
        epoch, place = divmod(step, n)
        if epoch != self._epoch:
            order = np.random.default_rng((self._seed, epoch, n)).permutation(n)
            self._epoch, self._order = epoch, order.tolist()
        index = self._order[place]
        view = self.views[index]
        jitter = self._jitter(view, rng) if self._jitters else (0, 0)
        box = (0, 0, view.camera.width, view.camera.height)
        if self.side:
            x0, y0, x1, y1 = self._boxes[index]
            width, height = view.crop_size(self.side)
            left = draw_start(rng, x0, x1, width, limit=view.camera.width)
            top = draw_start(rng, y0, y1, height, limit=view.camera.height)
            box = (left, top, width, height)
        return Crop(index, view, box, jitter, view.crop_camera(box, jitter))

    def _jitter(self, view, rng):
        """Crop.jitter: for a reduced view a whole number of stored pixels within a block. Other
        views are shifted by a fraction of a pixel, unless some pixels are ignored: interpolation
        would spread these.
        """
        if view.downscale > 1:
            return tuple(rng.integers(view.downscale, size=2).tolist())
        if view.ignored is None:
            return tuple(rng.uniform(-BETWEEN, BETWEEN, 2).tolist())
        return 0, 0


def crop_side(side: int, halvings: int) -> int:
    """The setting train.crop, for images halved this many times: whole quads of pixels."""
    return 4 * round(side * (1 - CROP_LOSS * halvings) / 4)


def draw_start(rng: np.random.Generator, low: int, high: int, size: int, *, limit: int) -> int:
    """First pixel of a crop of `size` pixels inside [0, limit) that shows as much as possible of
    the object, which covers [low, high).

    Each end of the object is in at least END_SHARE of the crops: uniform draws hardly ever show the
    ends of an object much wider than a crop.
    """
    first, last = sorted((low, high - size))
    first, last = max(first, 0), max(min(last, limit - size), 0)
    start = int(rng.integers(first, last + 1))
    end, inside = rng.random(), int(rng.integers(BOX_MARGIN + 1))
    uniform = min((BOX_MARGIN + 1) / (last - first + 1), END_SHARE)
    drawn = (END_SHARE - uniform) / (1 - 2 * uniform)
    if high - low > size and end < drawn:
        start = min(first + inside, last)
    elif high - low > size and end > 1 - drawn:
        start = max(last - inside, first)
    return start
