"""The training state of each point: optimiser moments, EMA, highest blend weight and view count."""

from __future__ import annotations

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Table, compact_rows, gather_rows
from pp_cl.engine.device.device import Device
from pp_cl.engine.raster.points import PointCloud, sh_blocks


class PointState:
    """Arrays with one row per point of the cloud, in its order; they start as zeros.

    arrays: {name as in table(): array}. averages: {name as in PointCloud.learned(): EMA}, empty
    until Optimiser.update_ema().
    """

    def __init__(self, dev: Device, cloud: PointCloud):
        table = self.table(cloud.count, cloud.offset.shape[1])
        self.arrays = {name: dev.zeros(*row) for name, row in table.items()}
        self.averages: dict[str, Array] = {}

    @staticmethod
    def table(n: int, width: int = 4) -> Table:
        """The arrays of n points without the averages. width: columns of PointCloud.offset."""
        return {
            "max_weight": ((n,), np.float32),
            "times_seen": ((n,), np.float32),
            "v.offset": ((n, width), np.float32),
            "v.opacity": ((n,), np.float32),
            "v.sh": ((n, 16), np.float32),
            "last_step": ((n,), np.uint32),
        }

    @staticmethod
    def ema_table(n: int) -> Table:
        """The averages of n points: for all parameters but harmonics above degree 0, whose averages
        would take most of the memory and gain 0.02 dB.
        """
        table = PointCloud.table(n, sh_blocks(0))
        del table["ids"]
        return table

    @property
    def max_weight(self) -> Array:
        """(N) float32: the sum of the point's blend weights over an image's pixels, its highest
        value in all images since pruning last judged the point.
        """
        return self.arrays["max_weight"]

    @property
    def times_seen(self) -> Array:
        """(N) float32: number of images, since pruning last judged the point, with a fragment of
        it, occluded or not.
        """
        return self.arrays["times_seen"]

    @property
    def second_moments(self) -> dict[str, Array]:
        """RMSprop's second moments, float32: "offset" (N, 4), "opacity" (N,) and "sh" (N, 16), one
        for each feature.
        """
        return {name: self.arrays[f"v.{name}"] for name in ("offset", "opacity", "sh")}

    @property
    def last_step(self) -> Array:
        """(N,) uint32: the last step in which the point had a gradient; 0: none yet."""
        return self.arrays["last_step"]

    def compact(self, dev: Device, keep: Array) -> None:
        """Drop all rows but `keep`, (M) uint32, ascending; one array after the other."""
        for arrays in (self.arrays, self.averages):
            for name in arrays:
                arrays[name] = compact_rows(dev, arrays[name], keep)

    def refine(self, dev: Device, parents: Array) -> None:
        """Become the state of a refined cloud: point i takes over the state of parents[i], (M,)
        uint32, but max_weight and times_seen start anew.
        """
        for arrays in (self.arrays, self.averages):
            for name in arrays:
                arrays[name] = gather_rows(dev, arrays[name], parents)
        for array in (self.max_weight, self.times_seen):
            dev.fill(array, 0)


def split_opacity(dev: Device, opacity: Array) -> None:
    """Replace every opacity o in [0, 1], (N, 9) float32 of PointCloud, by 1 - sqrt(1 - o), in
    place, and scale the columns that depend on the direction like o. On a refined grid a ray
    crosses two points where it crossed one, and their transmittances multiply to 1 - o.
    """
    n = len(opacity)
    dev.program("training/refine").launch("split_opacity", n, n=n, opacity=opacity)
