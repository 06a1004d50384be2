"""All (point, pixel) hits of one view, by point and by pixel."""

import numpy as np

from pp_cl.scan import exclusive_scan, nonzero, read_total

GROWTH = 1.25  # spare room of the pair buffers, so that they are not replaced at every view


class Pairs:
    """The hits of the view built last, with the buffers they live in; these grow and are kept from view to view.

    total: number of pairs; P >= total is the length of the pair buffers. seen: (S) uint32, the points with a pair, ascending.
    point_offset: (N+1) uint32, point i owns the pairs point_offset[i] to point_offset[i+1]. pixel_offset: (HW+1) uint32.
    pair_pixel: (P) uint32. pair_closeness: (P) float32, the d of Eq. (1). point_from_pair: (P) uint32.
    pair_key: (P) uint64, depth bits << 32 | pair, by pixel and sorted within it. hit: (P) uint64, free for the blend.
    """

    def __init__(self, dev, footprint):
        self.dev = dev
        self.program = dev.program("pairs", **footprint.defines)
        self.points = self.pixels = self.capacity = 0

    def build(self, view, size, projection, point_radius):
        """Find and sort the hits of projected points. Waits for the device twice, to learn how many there are.

        view: (20) packed camera. size: its (height, width). projection: Projection with N points. point_radius: (1) or (N).
        """
        dev, program = self.dev, self.program
        n, hw = projection.point_camera.shape[0], size[0] * size[1]
        self._resize(n, hw)
        points = {"n": n, "k": point_radius.size, "camera": view, "point_radius": point_radius,
                  "point_camera": projection.point_camera, "point_box": projection.point_box}
        program.launch("pairs_count", n, point_count=self.point_count, **points)
        self.seen = self.seen_index[:nonzero(dev, self.point_count, self.point_offset, self.seen_index)]
        exclusive_scan(dev, self.point_count, self.point_offset)
        self.total = read_total(dev, self.point_offset)
        self._reserve(self.total)
        dev.fill(self.pixel_count, 0)
        program.launch("pairs_fill", n, point_offset=self.point_offset, pair_pixel=self.pair_pixel, pair_place=self.hit,
                       pair_closeness=self.pair_closeness, point_from_pair=self.point_from_pair, pixel_count=self.pixel_count, **points)
        exclusive_scan(dev, self.pixel_count, self.pixel_offset)
        program.launch("pairs_scatter", self.total, pairs=self.total, pair_pixel=self.pair_pixel, pair_place=self.hit,
                       pixel_offset=self.pixel_offset, pair_key=self.pair_key)
        program.launch("pairs_sort", hw, hw=hw, pixel_offset=self.pixel_offset, scratch=self.hit, pair_key=self.pair_key)

    def _resize(self, n, hw):
        """Buffers for n points and hw pixels."""
        dev = self.dev
        if n != self.points:
            self.points = n
            self.point_count = dev.empty((n,), np.uint32)
            self.point_offset = dev.empty((n + 1,), np.uint32)
            self.seen_index = dev.empty((n,), np.uint32)
        if hw != self.pixels:
            self.pixels = hw
            self.pixel_count = dev.empty((hw,), np.uint32)
            self.pixel_offset = dev.empty((hw + 1,), np.uint32)

    def _reserve(self, total):
        """Buffers for at least `total` pairs, and never none at all."""
        if self.capacity > 0 and total <= self.capacity:
            return
        dev, self.capacity = self.dev, max(1, int(total * GROWTH))
        self.pair_key = self.hit = self.pair_pixel = self.pair_closeness = self.point_from_pair = None  # release before allocating
        self.pair_key = dev.empty((self.capacity,), np.uint64)
        self.hit = dev.empty((self.capacity,), np.uint64)
        self.pair_pixel = dev.empty((self.capacity,), np.uint32)
        self.pair_closeness = dev.empty((self.capacity,))
        self.point_from_pair = dev.empty((self.capacity,), np.uint32)
