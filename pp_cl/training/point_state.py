"""What training keeps for each point beside what is learned."""

from __future__ import annotations

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.device.rows import DeviceRows, compact_rows, gather_rows
from pp_cl.raster.point_cloud import PointCloud
from pp_cl.raster.sh import ShBlock
from pp_cl.training.adam import Ema
from pp_cl.training.rmsprop import SecondMoment


class PointState:
    """Moments, blend weights and averages of a point cloud; rows as in the cloud.

    ema: averages by the names of PointCloud.learned().
    """

    def __init__(self, dev: Device, cloud: PointCloud):
        table = self.table(cloud.count)
        self.dev = dev
        self._arrays = {name: dev.zeros(*row) for name, row in table.items()}
        self.ema = Ema(dev)

    @staticmethod
    def table(n: int) -> Table:
        """The arrays of n points without the averages; all start as zeros."""
        table = dict.fromkeys(("peak_weight", "look_count"), ((n,), np.float32))
        table |= {f"{kind}.opacity": ((n,), np.float32) for kind in "mv"}
        return table | {"v.sh": ((n, 16), np.float32), "last_step": ((n,), np.uint32)}

    @staticmethod
    def ema_table(n: int, blocks: tuple[ShBlock, ...]) -> Table:
        """The averages of n points."""
        table = PointCloud.table(n, blocks)
        del table["ids"]
        return table

    @property
    def peak_weight(self) -> Array:
        """(N) float32: the highest blend weight of a look since the point was last judged, summed
        over the pixels.
        """
        return self._arrays["peak_weight"]

    @property
    def look_count(self) -> Array:
        """(N) float32: steps since then that had the point in their image, hidden or not."""
        return self._arrays["look_count"]

    @property
    def sh_moment(self) -> SecondMoment:
        """Of the SH coefficients."""
        return SecondMoment(self._arrays["v.sh"], self._arrays["last_step"])

    @property
    def opacity_moments(self) -> dict[str, Array]:
        """Adam's "m" and "v", (N,) each."""
        return {kind: self._arrays[f"{kind}.opacity"] for kind in "mv"}

    def compact(self, dev: Device, keep: Array) -> None:
        """Drop all rows but `keep`, (M) uint32, ascending; one array after the other."""
        for arrays in (self._arrays, self.ema.arrays):
            for name in arrays:
                arrays[name] = compact_rows(dev, arrays[name], keep)

    def replace_by(self, dev: Device, rows: Array) -> None:
        """Become the state of points that each take over that of point rows[i], but for peaks
        and looks, which start anew. rows: (M,) uint32.
        """
        for arrays in (self._arrays, self.ema.arrays):
            for name in arrays:
                arrays[name] = gather_rows(dev, arrays[name], rows)
        for array in (self.peak_weight, self.look_count):
            dev.fill(array, 0)

    def arrays(self) -> dict[str, DeviceRows]:
        """{name in a checkpoint: array}."""
        averages = {f"a.{name}": array for name, array in self.ema.arrays.items()}
        arrays = (self._arrays | averages).items()
        return {f"state.{name}": DeviceRows(self.dev, array) for name, array in arrays}

    def restore(self, cloud: PointCloud, arrays: dict[str, np.ndarray]) -> None:
        """Take the state out of the arrays of a checkpoint, as stored.py has checked it."""
        for name, array in self._arrays.items():
            self.dev.write(array, arrays.pop(f"state.{name}"))
        learned = cloud.learned()
        keys = {name: f"state.a.{name}" for name in learned}
        self.ema.restore(learned, {n: arrays.pop(key) for n, key in keys.items() if key in arrays})
