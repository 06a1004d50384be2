"""All (point, pixel) hits of one view, by point and by pixel."""

import numpy as np

from pp_cl.device.scan import exclusive_scan, nonzero, read_total
from pp_cl.errors import UserError

MOST_PAIRS = 2**32 - 1  # that can be numbered
PAIR_ARRAYS = {
    "pair_pixel": ((), np.uint32),
    "pair_source": ((2,), np.uint32),
    "pair_key": ((), np.uint64),
    "hit": ((), np.uint64),
}  # shape and dtype of a pair's row
# What build() makes and no later stage changes.
LASTING = ("seen", "point_offset", "pixel_offset", "pair_pixel", "pair_source", "pair_key")
GROWTH = 1.25  # spare room of the pair buffers, so that they are not replaced at every view


class Pairs:
    """The hits of the view built or adopted last; the buffers grow and are kept from view to view.

    total: number of pairs; P = max(1, total). seen: (S) uint32, the points with a pair, ascending.
    point_offset: (N+1) uint32, point i owns the pairs point_offset[i] to point_offset[i+1].
    pair_pixel: (P) uint32, y*W + x. pair_source: (P,2) uint32, the point, and the bits of the d of
    Eq. (1). pixel_offset: (HW+1) uint32, pixel q owns the keys pixel_offset[q] to
    pixel_offset[q+1]. pair_key: (P) uint64, depth bits << 32 | pair, sorted within each pixel: by
    depth, then by point. hit: (P) uint64, scratch here; Weights lists each pixel's weights and
    points in it.
    """

    def __init__(self, dev, footprint):
        self.dev = dev
        self.program = dev.program("raster/pairs", **footprint.defines)
        self.points = self.pixels = self.capacity = 0
        self._of_points, self._of_pixels, self._of_pairs = {}, {}, {}

    def build(self, view, size, projection, point_radius):
        """Find and sort the hits of projected points. Waits for the device, to learn how many there
        are.

        Raises UserError for more than can be numbered or kept in the device's memory.

        view: (20) packed camera. size: its (height, width). projection: Projection of N points.
        point_radius: (1) or (N) float32, the radii they were projected with.
        """
        n, hw = projection.point_camera.shape[0], size[0] * size[1]
        launch = self.program.launch
        self._resize(n, hw)
        points = {
            "n": n,
            "k": point_radius.size,
            "camera": view,
            "point_radius": point_radius,
            "point_camera": projection.point_camera,
            "point_box": projection.point_box,
        }

        point_count, seen_index = self._of_points["count"], self._of_points["seen"]
        launch("pairs_count", n, point_count=point_count, **points)
        self.seen = seen_index[: nonzero(self.dev, point_count, self.point_offset, seen_index)]
        exclusive_scan(self.dev, point_count, self.point_offset)
        self._reserve(read_total(self.dev, self.point_offset))

        pixel_count = self._of_pixels["count"]
        self.dev.fill(pixel_count, 0)
        launch(
            "pairs_fill",
            n,
            point_offset=self.point_offset,
            pair_pixel=self.pair_pixel,
            pair_source=self.pair_source,
            pair_place=self.hit,
            pixel_count=pixel_count,
            **points,
        )
        exclusive_scan(self.dev, pixel_count, self.pixel_offset)
        launch(
            "pairs_scatter",
            self.total,
            pairs=self.total,
            pair_pixel=self.pair_pixel,
            pair_place=self.hit,
            pixel_offset=self.pixel_offset,
            pair_key=self.pair_key,
        )
        launch(
            "pairs_sort",
            hw,
            hw=hw,
            pixel_offset=self.pixel_offset,
            scratch=self.hit,
            pair_key=self.pair_key,
        )

    def adopt(self, total, arrays):
        """Take over what build() once made, as {name: array}: the names of LASTING, and these
        sizes.
        """
        n, hw = arrays["point_offset"].size - 1, arrays["pixel_offset"].size - 1
        self._resize(n, hw)
        self._reserve(total)
        for name in LASTING:
            setattr(self, name, arrays[name])

    def _resize(self, n, hw):
        """Buffers for n points and hw pixels."""
        if n != self.points:
            self.points = n
            sizes = {"count": n, "offset": n + 1, "seen": n}
            self._of_points = {}  # released first
            self._of_points = {
                name: self.dev.empty((size,), np.uint32) for name, size in sizes.items()
            }
        if hw != self.pixels:
            self.pixels = hw
            sizes = {"count": hw, "offset": hw + 1}
            self._of_pixels = {
                name: self.dev.empty((size,), np.uint32) for name, size in sizes.items()
            }
        self.point_offset, self.pixel_offset = self._of_points["offset"], self._of_pixels["offset"]

    def _reserve(self, total):
        """Arrays for `total` pairs; old buffers are released before larger ones are allocated."""
        if total >= MOST_PAIRS:
            raise UserError(
                f"the points of one view cover more than {MOST_PAIRS} pixels in all: lower"
                " --points, raise --downscale, or lower raster.radius"
            )
        self.total, p = total, max(1, total)
        if self.capacity < p:
            self.capacity = max(1, int(total * GROWTH))
            for name in PAIR_ARRAYS:
                setattr(self, name, None)
            self._of_pairs = {}
            for name, (row, dtype) in PAIR_ARRAYS.items():
                self._of_pairs[name] = self.dev.empty((self.capacity, *row), dtype)
        for name in PAIR_ARRAYS:
            setattr(self, name, self._of_pairs[name][:p])
