"""The weights of Eq. (1), and what can be left out of a picture without changing it by more than a
bound.
"""

import numpy as np

from pp_cl.device.scan import nonzero

ALL = 2**32 - 1


class Weights:
    """The weights of the hits of a Pairs object in the view weighed last.

    pair_weight: (P,2) float32, see cl/raster/blend_weights.cl. kept: (S) uint32, ascending, the
    points that are a part of the picture: no other has its features read, or gets a gradient.
    Without stop and tau these are pairs.seen.
    """

    def __init__(self, dev):
        self.dev = dev
        self.program = dev.program("raster/blend_weights")
        self.pair_weight = self.kept = self._buffer = self._lists = None

    def weigh(self, pairs, view, opacity, gamma, max_tracked=0, stop=0.0, tau=0.0):
        """Weigh all pairs. Overwrites pairs.hit with each pixel's list of weights and points.

        view: (20) packed camera. opacity: (N) in [0, 1]. max_tracked: only so many nearest hits of
        a pixel get gradients (64 in the paper); 0: all. stop: Pulsar's percent_allowed_difference
        in [0, 1), 0.001 in the paper: a pixel drops the hits behind the depth where none can have
        this share any more; 0: none. tau: in [0, 1), a pixel drops, from the back on, hits whose
        weights sum to no more than this; no feature of the pixel changes by more than tau times the
        range of that feature over the pixel's points and the background. 0: none.
        """
        if self._buffer is None or len(self._buffer) != pairs.capacity:
            self.pair_weight = self._buffer = None  # released first
            self._buffer = self.dev.empty((pairs.capacity, 2))
        self.pair_weight = self._buffer[: len(pairs.hit)]
        self.program.launch(
            "weights_of_hits",
            pairs.pixels,
            hw=pairs.pixels,
            max_tracked=max_tracked or ALL,
            gamma=gamma,
            least=stop,
            tau=tau,
            camera=view,
            pixel_offset=pairs.pixel_offset,
            pair_key=pairs.pair_key,
            pair_source=pairs.pair_source,
            opacity=opacity,
            pair_weight=self.pair_weight,
            hit=pairs.hit,
        )
        self.kept = self._kept(pairs) if stop > 0 or tau > 0 else pairs.seen

    def dropped(self, pairs):
        """(HW) float32 device array: the weight that tau took from each pixel, or a bound of it
        just above; at most tau.
        """
        pixel_dropped = self.dev.empty((pairs.pixels,))
        self.program.launch(
            "weights_dropped",
            pairs.pixels,
            hw=pairs.pixels,
            pixel_offset=pairs.pixel_offset,
            hit=pairs.hit,
            pixel_dropped=pixel_dropped,
        )
        return pixel_dropped

    def add_point_weights(self, pairs, point_weight):
        """Add to point_weight (N) the sum of each point's weights over the pixels."""
        self.program.launch(
            "weights_of_points",
            pairs.points,
            n=pairs.points,
            point_offset=pairs.point_offset,
            pair_weight=self.pair_weight,
            point_weight=point_weight,
        )

    def _kept(self, pairs):
        """The points of which a hit is left. Waits for the device."""
        n = pairs.points
        if self._lists is None or self._lists[0].size != n:
            self._lists = [self.dev.empty((size,), np.uint32) for size in (n, n + 1, n)]
        point_kept, offsets, indices = self._lists
        self.program.launch(
            "weights_kept",
            n,
            n=n,
            point_offset=pairs.point_offset,
            pair_weight=self.pair_weight,
            point_kept=point_kept,
        )
        return indices[: nonzero(self.dev, point_kept, offsets, indices)]
