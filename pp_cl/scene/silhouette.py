"""Gives images without a mask the silhouette of the other masks' visual hull."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from pp_cl.engine.device.device import Device
from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.scene.hull import agreeing, build_grid, silhouette

POINTS, SIDE = 250_000, 400  # points of the hull, and pixels of the images that show it
# The ignored rim of a silhouette, as shares of the image's longer side: inwards, since the hull is
# larger than the object, by 1 to 4 % of its pixels; outwards, since its points have a size.
INWARD, OUTWARD = 0.05, 0.005


def within_silhouettes(dev: Device, views: Sequence[View], bare: Sequence[View]) -> list[View]:
    """The views without a mask, made transparent outside the hull that the masks of the others
    leave and opaque well inside it; the rim in between is ignored. Raises UserError as build_grid()
    does, and if the masks contradict each other, since such views then do more harm than good.
    """
    agreement = agreeing(dev, views)
    if agreement.forgiven:
        raise UserError("the masks contradict each other; add the missing masks")
    hull = build_grid(dev, agreement.views, POINTS)
    filled = []
    for view in bare:
        small = view.near_size(SIDE)
        covered = silhouette(hull.grid, hull.ids, small.camera)
        side = max(covered.shape)
        is_inside = _distance(covered) > INWARD * side
        is_outside = _distance(~covered) > max(OUTWARD * side, 1)
        inside, rim = (
            _enlarged(a, view.image.shape, small.downscale)
            for a in (is_inside, ~is_inside & ~is_outside)
        )
        image, ignored = view.image.copy(), rim if view.ignored is None else rim | view.ignored
        image[..., 3] = np.where(inside, image[..., 3], 0)
        image[ignored] = 0
        filled.append(replace(view, image=image, ignored=ignored, is_masked=True))
    return filled


def _distance(covered):
    """(H, W) distances in pixels from each covered pixel to the nearest uncovered one."""
    if covered.all():
        return np.full(covered.shape, np.inf)
    return distance_transform_edt(covered)


def _enlarged(values, shape, times):
    """(H, W) values of a reduced image's pixels, repeated for the image of a shape (H, W, 4)."""
    whole = values.repeat(times, axis=0).repeat(times, axis=1)
    beyond = [(0, n - m) for n, m in zip(shape, whole.shape, strict=False)]
    return np.pad(whole, beyond, mode="edge")
