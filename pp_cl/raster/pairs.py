"""All hits of one view, a hit being a pair of a point and a pixel: listed by point and by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table, grown
from pp_cl.device.device import Device
from pp_cl.device.form import lanes
from pp_cl.device.scan import exclusive_scan, nonzero, read_total
from pp_cl.errors import UserError
from pp_cl.raster.project import Footprint, ProjectedPoints

MOST_PAIRS = 2**32 - 1  # pairs are numbered by uint32


@dataclass(frozen=True)
class Pairs:
    """The hits of a view of N points and HW pixels, valid until the next one is built.

    total: number of pairs; P = max(1, total). seen: (S,) uint32, the points with a pair, ascending.
    point_offset: (N+1,) uint32, point i owns pairs point_offset[i] to point_offset[i+1].
    pixel_offset: (HW+1,) uint32, pixel q owns keys pixel_offset[q] to pixel_offset[q+1].
    pair_pixel: (P,) uint32, y*W + x. pair_point_closeness: (P, 2) uint32, the point, and the bits
    of the closeness d of Eq. (1). pair_key: (P,) uint64, depth bits << 32 | pair, sorted within
    each pixel by depth, then by point.
    """

    total: int
    seen: Array
    point_offset: Array
    pixel_offset: Array
    pair_pixel: Array
    pair_point_closeness: Array
    pair_key: Array

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
        self.program = dev.program("raster/pairs", LANES=lanes(dev), **footprint.defines)
        self._buffers = Buffers(dev)
        self._capacity = 0

    @staticmethod
    def table(n: int, pixels: int, pairs: int) -> Table:
        """The buffers for n points, a number of pixels and room for a number of pairs."""
        return {
            "point_count": ((n,), np.uint32),
            "point_offset": ((n + 1,), np.uint32),
            "seen": ((n,), np.uint32),
            "pixel_count": ((pixels,), np.uint32),
            "pixel_offset": ((pixels + 1,), np.uint32),
            "pair_pixel": ((pairs,), np.uint32),
            "pair_point_closeness": ((pairs, 2), np.uint32),
            "pair_key": ((pairs,), np.uint64),
            "pair_scratch": ((pairs,), np.uint64),
        }

    def build(self, points: ProjectedPoints, size: tuple[int, int]) -> Pairs:
        """Pairs of an image of size (height, width). Waits for the device to learn their number.

        Raises UserError for more pairs than can be numbered or kept in the device's memory.
        """
        n, pixels, b, launch = len(points.point_box), size[0] * size[1], self._buffers, self._launch
        b.require(self.table(n, pixels, max(1, self._capacity)))
        launch("pairs_count", n, points, point_count=b.point_count)
        seen = b.seen[: nonzero(self.dev, b.point_count, b.point_offset, b.seen)]
        exclusive_scan(self.dev, b.point_count, b.point_offset)
        total = self._reserve(n, pixels, read_total(self.dev, b.point_offset))

        names = ("pair_pixel", "pair_point_closeness", "pair_key", "pair_scratch")
        pair = {name: getattr(b, name)[: max(1, total)] for name in names}
        scratch = pair.pop("pair_scratch")
        self.dev.fill(b.pixel_count, 0)
        launch(
            "pairs_fill",
            n,
            points,
            point_offset=b.point_offset,
            pair_pixel=pair["pair_pixel"],
            pair_point_closeness=pair["pair_point_closeness"],
            pair_place=scratch,
            pixel_count=b.pixel_count,
        )
        exclusive_scan(self.dev, b.pixel_count, b.pixel_offset)
        self.program.launch(
            "pairs_scatter",
            total,
            pairs=total,
            pair_pixel=pair["pair_pixel"],
            pair_place=scratch,
            pixel_offset=b.pixel_offset,
            pair_key=pair["pair_key"],
        )
        self._sort(pixels, total, pair["pair_pixel"], pair["pair_key"], scratch=scratch)
        return Pairs(total, seen, b.point_offset, b.pixel_offset, **pair)

    def _sort(self, pixels, total, pair_pixel, pair_key, *, scratch):
        """Sort the keys of each pixel in place."""
        keys = {"pixel_offset": self._buffers.pixel_offset, "pair_key": pair_key}
        if self.dev.is_cpu:
            self.program.launch("pairs_sort", pixels, hw=pixels, scratch=scratch, **keys)
            return
        keys |= {"pairs": total, "pair_pixel": pair_pixel, "sorted": scratch}
        self.program.launch("pairs_sort_runs", total, **keys)
        self.program.launch("pairs_merge_runs", total, **keys)

    def _launch(self, kernel, n, points, **arguments):
        """Launch a kernel that walks over the pixels of each point's box."""
        self.program.launch(
            kernel,
            n,
            n=n,
            radii=points.point_radius.size,
            camera=points.camera_buffer,
            point_radius=points.point_radius,
            point_camera=points.point_camera,
            point_box=points.point_box,
            **arguments,
        )

    def _reserve(self, n, pixels, total):
        """Make room for `total` pairs; returns that number."""
        if total >= MOST_PAIRS:
            raise UserError(
                f"the points of one view cover more than {MOST_PAIRS} pixels in all: "
                "lower --points, raise --downscale, or lower raster.radius"
            )
        self._capacity = grown(self._capacity, total)
        self._buffers.require(self.table(n, pixels, max(1, self._capacity)))
        return total
