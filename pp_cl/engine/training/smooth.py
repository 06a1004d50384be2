"""Smoothing: pulls the SH coefficients of each point towards the mean of its grid neighbours,
independently of the optimiser, whose moments do not change.
"""

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, row_parts


def smoothing_table(n: int) -> Table:
    """The arrays of a Smoother for n points."""
    return {"neighbours": ((n, 6), np.uint32), "colour": ((n,), np.uint8)}


class Smoother:
    """Smooths per-point coefficients over the grid; made anew when the points change.

    grid: (8,) of Grid.packed(). ids: (N,) uint32 grid ids, ascending. neighbours: (N, 6) uint32,
    index of each point's neighbours -x, +x, -y, +y, -z, +z; 0xffffffff where the grid has no point.
    """

    def __init__(self, dev: Device, grid: Array, ids: Array):
        n = len(ids)
        self.neighbours, self._colour = (dev.empty(*row) for row in smoothing_table(n).values())
        self._program = dev.program("training/smooth", LANES=lanes(dev))
        self._parts = row_parts(dev)
        self._program.launch(
            "neighbour_table",
            n,
            n=n,
            grid=grid,
            ids=ids,
            neighbours=self.neighbours,
            colour=self._colour,
        )

    def smooth(self, sh: Array, amount: float) -> None:
        """Move every coefficient f, in place: f += amount * (mean of the existing neighbours' f -
        f), first for the points whose grid indices have an even sum, then for the others.

        A point without neighbours keeps its coefficients. amount: 0 to 1. sh: (N, K, 16) float32.
        """
        n, k, _ = sh.shape
        for colour in (0, 1):
            self._program.launch(
                "smooth_colour",
                n * self._parts,
                n=n,
                k=k,
                moved=colour,
                amount=amount,
                neighbours=self.neighbours,
                colour=self._colour,
                sh=sh,
            )
