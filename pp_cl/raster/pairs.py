"""All hits of one view, a hit being a pair of a point and a pixel: listed by point and by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table, grown
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes
from pp_cl.device.scan import exclusive_scan, read_total
from pp_cl.device.transfer import Reading
from pp_cl.errors import UserError
from pp_cl.raster.project import Footprint, ProjectedPoints

MOST_PAIRS = 2**32 - 1  # pairs are numbered by uint32
RUN = 64  # keys ranked at once by comparing all with all; longer lists are merged
LONG_LIST = RUN * RUN  # keys of lists that GPUs merge in more than one pass


@dataclass(frozen=True)
class Pairs:
    """The hits of a view of N points and HW pixels, valid until the next one is built.

    P is what there was room for: where there are more pairs, there are none of the pixels, and
    those of the points must not be read.

    count: of one number, how many pairs there are.
    point_offset: (N+1,) uint32, point i owns pairs point_offset[i] to point_offset[i+1].
    pixel_offset: (HW+1,) uint32, pixel q owns keys pixel_offset[q] to pixel_offset[q+1].
    pair_pixel: (P,) uint32, y*W + x. pair_point_closeness: (P, 2) uint32, the point, and the bits
    of the closeness d of Eq. (1). pair_key: (P,) uint64, depth bits << 32 | pair, sorted within
    each pixel by depth, then by point.
    """

    count: Reading
    point_offset: Array
    pixel_offset: Array
    pair_pixel: Array
    pair_point_closeness: Array
    pair_key: Array

    @property
    def total(self) -> int:
        """The number of pairs; waits until it is known."""
        return int(self.count.get()[0])

    @property
    def capacity(self) -> int:
        """P."""
        return len(self.pair_pixel)

    @property
    def points(self) -> int:
        """N."""
        return self.point_offset.size - 1

    @property
    def pixels(self) -> int:
        """HW."""
        return self.pixel_offset.size - 1


class PairBuilder:
    """Finds and sorts the hits of projected points; the buffers grow and are reused."""

    def __init__(self, dev: Device, footprint: Footprint):
        self.dev = dev
        self._lanes = lanes(dev)
        self.program = dev.program("raster/pairs", LANES=self._lanes, RUN=RUN, **footprint.defines)
        self._buffers = Buffers(dev)
        self._capacity = 0

    @staticmethod
    def table(n: int, pixels: int, pairs: int) -> Table:
        """The buffers for n points, a number of pixels and room for a number of pairs."""
        return {
            "point_offset": ((n + 1,), np.uint32),
            "pixel_count": ((pixels,), np.uint32),
            "pixel_offset": ((pixels + 1,), np.uint32),
            "pair_pixel": ((pairs,), np.uint32),
            "pair_point_closeness": ((pairs, 2), np.uint32),
            "pair_key": ((pairs,), np.uint64),
            "pair_scratch": ((pairs,), np.uint64),
        }

    def build(self, points: ProjectedPoints, size: tuple[int, int]) -> Pairs:
        """Pairs of an image of size (height, width), with room for all. Waits for the device.

        Raises UserError for more pairs than can be numbered or kept in the device's memory.
        """
        while True:
            pairs = self.enqueue(points, size)
            if self.has_room(pairs):
                return pairs
            del pairs  # else its arrays would stay beside the larger ones

    def has_room(self, pairs: Pairs) -> bool:
        """Whether there was room for the pairs; if not, the next ones will have it. Waits until
        their number is known. Raises UserError as build() does.
        """
        total = pairs.total
        if total >= MOST_PAIRS:
            raise UserError(
                f"the points of one view cover more than {MOST_PAIRS} pixels in all: "
                "lower --points, raise --downscale, or lower raster.radius"
            )
        if total > pairs.capacity:
            self._capacity = grown(self._capacity, total)
        return total <= pairs.capacity

    def enqueue(self, points: ProjectedPoints, size: tuple[int, int]) -> Pairs:
        """As build(), but without waiting, and perhaps without room."""
        n, pixels, b = len(points.point_box), size[0] * size[1], self._buffers
        capacity = max(1, self._capacity)
        b.require(self.table(n, pixels, capacity))
        exclusive_scan(self.dev, points.point_count, b.point_offset)
        count = read_total(self.dev, b.point_offset)
        self.dev.fill(b.pixel_count, 0)
        self.program.launch(
            "pairs_fill",
            -(-n // self._lanes),
            n=n,
            p=capacity,
            radii=points.point_radius.size,
            camera=points.camera_buffer,
            point_radius=points.point_radius,
            point_camera=points.point_camera,
            point_box=points.point_box,
            point_offset=b.point_offset,
            pair_pixel=b.pair_pixel,
            pair_point_closeness=b.pair_point_closeness,
            pair_place=b.pair_scratch,
            pixel_count=b.pixel_count,
        )
        exclusive_scan(self.dev, b.pixel_count, b.pixel_offset)
        self.program.launch(
            "pairs_scatter",
            capacity,
            p=capacity,
            hw=pixels,
            pair_pixel=b.pair_pixel,
            pair_place=b.pair_scratch,
            pixel_offset=b.pixel_offset,
            pair_key=b.pair_key,
        )
        self._sort(pixels, capacity)
        fields = ("point_offset", "pixel_offset", "pair_pixel", "pair_point_closeness", "pair_key")
        return Pairs(count, **{name: getattr(b, name) for name in fields})

    def _sort(self, pixels, capacity):
        """Sort the keys of each pixel in place."""
        b = self._buffers
        keys = {"hw": pixels, "pixel_offset": b.pixel_offset, "pair_key": b.pair_key}
        if self.dev.is_cpu:
            self.program.launch("pairs_sort", pixels, scratch=b.pair_scratch, **keys)
            return
        keys |= {"p": capacity, "pair_pixel": b.pair_pixel, "sorted": b.pair_scratch}
        self.program.launch("pairs_sort_runs", capacity, **keys)
        self._merge(capacity, keys, width=RUN, group=LONG_LIST, least=0)
        if capacity > LONG_LIST:  # there and back, for the lists that are longer
            group = LONG_LIST * RUN
            there = {"sorted": b.pair_key, "pair_key": b.pair_scratch}
            self._merge(capacity, keys | there, width=LONG_LIST, group=group, least=LONG_LIST)
            self._merge(capacity, keys, width=group, group=MOST_PAIRS, least=LONG_LIST)

    def _merge(self, capacity, keys, **runs):
        self.program.launch("pairs_merge_runs", capacity, **keys, **runs)
