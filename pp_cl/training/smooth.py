"""Smoothing of the SH coefficients over the grid, outside Adam: its moments know nothing of it."""

import numpy as np

from pp_cl.raster.sh import SH_BLOCKS

NONE = 0xFFFFFFFF
# points smoothed at a time: their new values stay in a CPU's cache until they are written back
CHUNK = 16384
MOST_COEFFICIENTS = max(block.count for block in SH_BLOCKS)  # of one point in one array


def neighbour_table(dev, grid, ids):
    """(N, 6) uint32: index of each point's neighbours -x, +x, -y, +y, -z, +z; 0xffffffff where the
    grid has no point.

    grid: (8,) of Grid.packed(). ids: (N,) uint32 grid ids, ascending.
    """
    neighbours = dev.empty((len(ids), 6), np.uint32)
    dev.program("training/smooth").launch(
        "neighbour_table", len(ids), n=len(ids), grid=grid, ids=ids, neighbours=neighbours
    )
    return neighbours


class Smoother:
    """Smooths per-point coefficients over the grid; made anew when the points change.

    grid: (8,) of Grid.packed(). ids: (N,) uint32 grid ids, ascending.
    """

    def __init__(self, dev, grid, ids):
        self.dev = dev
        self.neighbours = neighbour_table(dev, grid, ids)
        # A chunk is written back once the next one is computed, so no neighbour may lie further
        # than one chunk away.
        after = self.neighbours.get()[:, 1::2]
        reach = np.where(
            after == NONE, 0, after - np.arange(len(ids), dtype=np.uint32)[:, None]
        ).max(initial=0)
        self.chunk = min(max(int(reach), CHUNK), len(ids))
        self._slots = [dev.empty((self.chunk * MOST_COEFFICIENTS, 16)) for _ in range(2)]

    def smooth(self, sh, amount):
        """Move every coefficient f, in place: f += amount * (mean of the existing neighbours' f -
        f).

        All reads see the old values; a point without neighbours stays as it is. amount: 0 to 1; 4 *
        lambda * learning rate for every fourth step. sh: (N, K, 16) float32, K up to 3; ValueError
        beyond.
        """
        launch = self.dev.program("training/smooth").launch
        n, coefficients, _ = sh.shape
        if coefficients > MOST_COEFFICIENTS:
            raise ValueError(f"at most {MOST_COEFFICIENTS} coefficients a point: {sh.shape}")
        waiting = None
        for start in range(0, n, self.chunk):
            part = {
                "first": start,
                "count": min(self.chunk, n - start),
                "smoothed": self._slots[start // self.chunk % 2],
                "n": n,
                "k": coefficients,
                "sh": sh,
            }
            launch(
                "smooth_gather", part["count"], neighbours=self.neighbours, amount=amount, **part
            )
            if waiting:
                launch("smooth_scatter", waiting["count"], **waiting)
            waiting = part
        if waiting:
            launch("smooth_scatter", waiting["count"], **waiting)
