"""Smoothing: pulls the SH coefficients of each point towards the mean of its grid neighbours, apart
from the optimiser, whose moments stay as they are.
"""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, row_parts
from pp_cl.raster.points import SH_BLOCKS

# points smoothed at a time: their new values stay in a CPU's cache until they are written back
CHUNK = 16384
REACH_RUN = 256  # points of which one work-item finds the furthest neighbour
MOST_COEFFICIENTS = max(block.count for block in SH_BLOCKS)  # of one point in one array


def chunk_points(n: int, furthest: int) -> int:
    """How many of n points are smoothed at a time, if neighbours lie up to `furthest` rows apart: a
    chunk is written back after the next one is computed, so it must be at least that long.
    """
    return min(max(furthest, CHUNK), n)


class Smoother:
    """Smooths per-point coefficients over the grid; made anew when the points change.

    grid: (8,) of Grid.packed(). ids: (N,) uint32 grid ids, ascending. neighbours: (N, 6) uint32,
    index of each point's neighbours -x, +x, -y, +y, -z, +z; 0xffffffff where the grid has no point.
    """

    def __init__(self, dev: Device, grid: Array, ids: Array):
        self.dev = dev
        n = len(ids)
        self._buffers = Buffers(dev)
        self._buffers.require({"neighbours": self.table(n, 0)["neighbours"]})
        self.neighbours = self._buffers.neighbours
        _program(dev).launch(
            "neighbour_table", n, n=n, grid=grid, ids=ids, neighbours=self.neighbours
        )
        self.chunk = chunk_points(n, self._furthest(n))
        self._buffers.require(self.table(n, self.chunk))

    def _furthest(self, n):
        """The largest distance of two neighbours, in rows."""
        runs = -(-n // REACH_RUN)
        furthest = self.dev.empty((runs,), np.uint32)
        _program(self.dev).launch(
            "furthest_neighbours",
            runs,
            n=n,
            run=REACH_RUN,
            neighbours=self.neighbours,
            furthest=furthest,
        )
        return int(self.dev.download(furthest).max(initial=0))

    @staticmethod
    def table(n: int, chunk: int) -> Table:
        """The arrays for n points that are smoothed `chunk` at a time."""
        smoothed = ((chunk * MOST_COEFFICIENTS, 16), np.float32)
        return {"neighbours": ((n, 6), np.uint32), "even": smoothed, "odd": smoothed}

    def smooth(self, sh: Array, amount: float) -> None:
        """Move every coefficient f, in place: f += amount * (mean of the existing neighbours' f -
        f).

        All reads see the old values; a point without neighbours keeps its own. amount: 0 to 1. sh:
        (N, K, 16) float32, K up to 3; ValueError beyond.
        """
        n, k, _ = sh.shape
        if k > MOST_COEFFICIENTS:
            raise ValueError(f"at most {MOST_COEFFICIENTS} coefficients a point: {sh.shape}")
        computed = None  # (first, count, smoothed) of the chunk that is not written back yet
        for i, first in enumerate(range(0, n, self.chunk)):
            count = min(self.chunk, n - first)
            smoothed = self._buffers.odd if i % 2 else self._buffers.even
            _program(self.dev).launch(
                "smooth_gather",
                count * row_parts(self.dev),
                n=n,
                first=first,
                count=count,
                k=k,
                amount=amount,
                neighbours=self.neighbours,
                sh=sh,
                smoothed=smoothed,
            )
            if computed:
                self._write_back(sh, *computed)
            computed = first, count, smoothed
        if computed:
            self._write_back(sh, *computed)

    def _write_back(self, sh, first, count, smoothed):
        """Write the smoothed coefficients of a chunk to its points."""
        n, k, _ = sh.shape
        _program(self.dev).launch(
            "smooth_write_back",
            count * row_parts(self.dev),
            n=n,
            first=first,
            count=count,
            k=k,
            smoothed=smoothed,
            sh=sh,
        )


def _program(dev):
    return dev.program("training/smooth", LANES=lanes(dev))
