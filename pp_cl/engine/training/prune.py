"""Decides which points are kept: during a training by the blend weights of its steps, at its end by
those of all training views.
"""

from collections.abc import Sequence

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.model import Model
from pp_cl.engine.render import Renderer
from pp_cl.engine.training import schedule
from pp_cl.engine.training.state import PointState
from pp_cl.engine.views import View
from pp_cl.errors import Diverged
from pp_cl.settings import Config, TrainConfig

LEAST_OPACITY = 0.01
MANY_VIEWS = 24  # with this many views, every place is seen by several
SPECK = 50  # points in a part of the object: a patch of 7 x 7 pixels if they are a pixel apart


def points_to_keep(dev: Device, state: PointState, opacity: Array, train: TrainConfig) -> Array:
    """(M,) uint32, ascending: the points that are kept during training. A point is judged once
    PRUNE_LOOKS steps had it in their image: it is kept if its blend weight reached
    train.prune_weight in one of them and its opacity, the mean of all sides, is at least
    LEAST_OPACITY, and is counted anew. Points seen less often are kept.

    The maximum decides, as a mean would drop what few views see, such as the inside of a gap.
    Raises Diverged for weights and opacities that are not finite, which nothing later would find.
    """
    weight, opacities = dev.download(state.max_weight), dev.download(opacity)[:, 0]
    broken = int((~np.isfinite(weight) | ~np.isfinite(opacities)).sum())
    if broken:
        raise Diverged(f"{broken} points have a weight or an opacity that is not finite")
    times_seen = dev.download(state.times_seen)
    judged = times_seen >= schedule.PRUNE_LOOKS
    passes = (weight >= np.float32(train.prune_weight)) & (opacities >= LEAST_OPACITY)
    dev.write(state.max_weight, np.where(judged, np.float32(0), weight))
    dev.write(state.times_seen, np.where(judged, np.float32(0), times_seen))
    return _listed(dev, ~judged | passes, weight)


def final_points_to_keep(
    dev: Device,
    max_weight: Array,
    times_seen: Array,
    opacity: Array,
    train: TrainConfig,
    least: int,
) -> Array:
    """(M,) uint32, ascending: the points of a finished training that weigh at least
    train.prune_weight in `least` training views and have LEAST_OPACITY. NaN counts as too little.

    max_weight, times_seen: (N,) float32, the highest blend weight in a training view, and in how
    many it is train.prune_weight.
    """
    weight, counts = dev.download(max_weight), dev.download(times_seen)
    keep = (weight >= train.prune_weight) & (counts >= least)
    return _listed(dev, keep & (dev.download(opacity)[:, 0] >= LEAST_OPACITY), weight)


def points_that_views_show(renderer: Renderer, views: Sequence[View], config: Config) -> Array:
    """The points that at least one training view shows, or two if there are many views: a point
    that only one shows is mostly a floater. (M,) uint32, as final_points_to_keep().
    """
    dev, cloud, train = renderer.dev, renderer.model.cloud, config.train
    max_weight, times_seen = (dev.zeros((cloud.count,)) for _ in range(2))
    for view in views:
        drawn = renderer.forward(view.camera, schedule.GAMMA[1], until="weights")
        renderer.record_weights(drawn, max_weight, times_seen, least=train.prune_weight)
        del drawn  # frees its arrays before the next view allocates
    least = 2 if len(views) >= MANY_VIEWS else 1
    return final_points_to_keep(dev, max_weight, times_seen, cloud.opacity, train, least)


def points_of_large_parts(model: Model) -> Array:
    """(M,) uint32, ascending: the points in connected parts that are large enough to be kept."""
    is_large = model.grid.in_large_parts(model.dev.download(model.cloud.ids), SPECK)
    return model.dev.upload(np.flatnonzero(is_large), np.uint32)


def _listed(dev, keep, weight):
    """Indices of the points to keep; if there are none, that of the highest weight."""
    indices = np.flatnonzero(keep)
    if indices.size == 0:
        indices = [np.argmax(np.nan_to_num(weight, nan=-np.inf))]
    return dev.upload(indices, np.uint32)
