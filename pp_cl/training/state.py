"""The training state of each point: optimiser moments, EMA, highest blend weight and view count;
and which points are pruned by the last two.
"""

from __future__ import annotations

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table, compact_rows, gather_rows
from pp_cl.device.device import Device
from pp_cl.errors import Diverged
from pp_cl.raster.points import PointCloud, ShBlock
from pp_cl.settings import TrainConfig


class PointState:
    """Arrays with one row per point of the cloud, in its order; they start as zeros.

    averages: {name as in PointCloud.learned(): EMA}, empty until Optimiser.update_ema().
    """

    def __init__(self, dev: Device, cloud: PointCloud):
        self._arrays = {name: dev.zeros(*row) for name, row in self.table(cloud.count).items()}
        self.averages: dict[str, Array] = {}

    @staticmethod
    def table(n: int) -> Table:
        """The arrays of n points without the averages."""
        return {
            "max_weight": ((n,), np.float32),
            "times_seen": ((n,), np.float32),
            "v.offset": ((n, 4), np.float32),
            "v.opacity": ((n,), np.float32),
            "v.sh": ((n, 16), np.float32),
            "last_step": ((n,), np.uint32),
        }

    @staticmethod
    def ema_table(n: int, blocks: tuple[ShBlock, ...]) -> Table:
        """The averages of n points: those of the SH coefficients in 16 bits, whose rounding is far
        below what ten updates a time constant leave of their noise.
        """
        table = PointCloud.table(n, blocks)
        del table["ids"]
        return table | {block.name: (table[block.name][0], np.float16) for block in blocks}

    @property
    def max_weight(self) -> Array:
        """(N) float32: the sum over an image's pixels of the point's blend weights, the highest of
        all images since pruning last judged the point.
        """
        return self._arrays["max_weight"]

    @property
    def times_seen(self) -> Array:
        """(N) float32: number of those images that had a hit of the point, occluded or not."""
        return self._arrays["times_seen"]

    @property
    def second_moments(self) -> dict[str, Array]:
        """RMSprop's: of "offset", (N, 4), "opacity", (N,), and "sh", (N, 16), of each feature; all
        float32.
        """
        return {name: self._arrays[f"v.{name}"] for name in ("offset", "opacity", "sh")}

    @property
    def last_step(self) -> Array:
        """(N,) uint32: the last step in which the point had a gradient; 0: none yet."""
        return self._arrays["last_step"]

    def compact(self, dev: Device, keep: Array) -> None:
        """Drop all rows but `keep`, (M) uint32, ascending; one array after the other."""
        for arrays in (self._arrays, self.averages):
            for name in arrays:
                arrays[name] = compact_rows(dev, arrays[name], keep)

    def refine(self, dev: Device, parents: Array) -> None:
        """Become the state of a refined cloud: point i takes over the state of parents[i], (M,)
        uint32, but max_weight and times_seen start anew.
        """
        for arrays in (self._arrays, self.averages):
            for name in arrays:
                arrays[name] = gather_rows(dev, arrays[name], parents)
        for array in (self.max_weight, self.times_seen):
            dev.fill(array, 0)

    def arrays(self) -> dict[str, Array]:
        """{name in a checkpoint: array}."""
        averages = {f"a.{name}": array for name, array in self.averages.items()}
        return {f"state.{name}": array for name, array in (self._arrays | averages).items()}


def split_opacity(dev: Device, opacity: Array) -> None:
    """Replace every opacity o in [0, 1], (N,) float32, by 1 - sqrt(1 - o), in place. On a refined
    grid a ray crosses two points where it crossed one, and their transmittances multiply to 1 - o.
    """
    n = len(opacity)
    dev.program("training/refine").launch("split_opacity", n, n=n, opacity=opacity)


def points_to_keep(dev: Device, state: PointState, opacity: Array, settings: TrainConfig) -> Array:
    """(M,) uint32, ascending: the points that are kept during training. A point is judged once
    train.prune_looks steps had it in their image: it is kept if its blend weight reached
    train.prune_weight in one of them and its opacity is at least train.prune_opacity, and its
    counts start anew. Points seen less often are kept.

    The maximum decides, as a mean would drop what few views see, such as the inside of a gap.
    Raises Diverged for weights and opacities that are not finite, which nothing later would find.
    """
    weight, seen = dev.download(state.max_weight), dev.download(state.times_seen)
    opacities = dev.download(opacity)
    broken = int((~np.isfinite(weight) | ~np.isfinite(opacities)).sum())
    if broken:
        raise Diverged(f"{broken} points have a weight or an opacity that is not finite")
    judged = seen >= settings.prune_looks
    passes = (weight >= settings.prune_weight) & (opacities >= settings.prune_opacity)
    dev.write(state.max_weight, np.where(judged, np.float32(0), weight))
    dev.write(state.times_seen, np.where(judged, np.float32(0), seen))
    return _listed(dev, ~judged | passes, weight)


def final_points_to_keep(
    dev: Device,
    max_weight: Array,
    times_seen: Array,
    opacity: Array,
    settings: TrainConfig,
    least: int,
) -> Array:
    """(M,) uint32, ascending: the points of a finished training that weigh at least
    train.final_prune_weight in `least` training views and have train.prune_opacity. NaN counts as
    too little.

    max_weight, times_seen: (N,) float32, the highest blend weight in a training view, and in how
    many it is train.final_prune_weight.
    """
    weight, seen = dev.download(max_weight), dev.download(times_seen)
    keep = (weight >= settings.final_prune_weight) & (seen >= least)
    return _listed(dev, keep & (dev.download(opacity) >= settings.prune_opacity), weight)


def _listed(dev, keep, weight):
    """Indices of the points to keep; if there are none, that of the highest weight."""
    indices = np.flatnonzero(keep)
    if indices.size == 0:
        indices = [np.argmax(np.nan_to_num(weight, nan=-np.inf))]
    return dev.upload(indices, np.uint32)
