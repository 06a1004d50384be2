"""The crops of views that a training learns from, one a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pp_cl.errors import UserError
from pp_cl.scene.camera import Camera
from pp_cl.scene.views import View
from pp_cl.settings import TrainConfig
from pp_cl.training.schedule import BOX_MARGIN, crop_side, draw_start

BETWEEN = 0.125  # pixels by which images at their own size are shifted: farther would blur them


class Crop(NamedTuple):
    """A part of a view. box: (x0, y0, width, height), pixels of its reduced
    image; jitter: stored pixels by which the reduced image starts further right and down; camera:
    of the part.
    """

    view_index: int
    view: View
    box: tuple[int, int, int, int]
    jitter: tuple[float, float]
    camera: Camera


class Crops:
    """Draws crops of views whose images are halved some times. Every choice is a function of
    (train.seed, step). Raises UserError where halved images are too small.

    views: the halved ones. side: of a crop, pixels; 0: whole images. halvings: how often.
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
        self._boxes = [view.object_bounds(BOX_MARGIN) for view in self.views]

    def draw(self, step: int) -> Crop:
        """The crop of a step: of views in a new random order every epoch, around the object."""
        rng, n = np.random.default_rng((self._seed, step)), len(self.views)
        epoch, place = divmod(step, n)
        index = int(np.random.default_rng((self._seed, epoch, n)).permutation(n)[place])
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
        """Crop.jitter: of a reduced view any stored pixels of a block. Others are shifted between
        their pixels, unless some of these say nothing, which would spread.
        """
        if view.downscale > 1:
            return tuple(rng.integers(view.downscale, size=2).tolist())
        if view.ignored is None:
            return tuple(rng.uniform(-BETWEEN, BETWEEN, 2).tolist())
        return 0, 0
