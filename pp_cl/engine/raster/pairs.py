"""Finds the fragments of a view, the pairs of a point and a pixel that it covers. Lists them by
point for the backward pass, and by pixel, sorted by depth, for blending.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table, grown
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, launch_groups, replayed
from pp_cl.engine.device.scan import BLOCK, blocks_of, exclusive_scan, read_total
from pp_cl.engine.raster.footprint import footprint_macros
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.errors import UserError

MOST_PAIRS = 2**32 - 1  # pairs are numbered by uint32
BUCKETS = 256  # most buckets of pairs; CPUs sort them in parallel
MOST_CHUNKS = 64  # most chunks of pairs; CPUs put them into buckets in parallel
RUN = 64  # keys that GPUs rank by comparing all with all; runs of this length are merged
LONG_LIST = RUN * RUN  # GPUs merge lists of more keys than this in several passes


@dataclass
class Pairs:
    """The fragments of a view of N points and HW pixels, valid until the next ones are found.

    The arrays have a capacity of P pairs. If the view has more, pixel_offset is all zeros and the
    other arrays must not be read: find the pairs again with more capacity (capacity_needed()).

    count: the number of pairs, downloaded by read_count(). point_offset: (N+1,) uint32, point i
    owns pairs point_offset[i] to point_offset[i+1]. pixel_offset: (HW+1,) uint32, pixel q owns keys
    pixel_offset[q] to pixel_offset[q+1]. pair_pixel: (P,) uint32, y*W + x. pair_point_falloff: (P,
    2) uint32, the point, and the bits of the falloff d of Eq. (1); if a pixel has several samples,
    (P, 1), only the point. pair_key: (P,) uint64, depth bits << 32 | pair, sorted within each pixel
    by depth, then by point.
    """

    point_offset: Array
    pixel_offset: Array
    pair_pixel: Array
    pair_point_falloff: Array
    pair_key: Array
    count: Any = None

    def read_count(self, dev: Device) -> None:
        """Enqueue the download of the number of pairs."""
        self.count = read_total(dev, self.point_offset)

    @property
    def total(self) -> int:
        """The number of pairs; waits until it is known."""
        return self.count.get()

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


def pairs_table(n: int, pixels: int, pairs: int, side: int = 1) -> Table:
    """The buffers for n points, a number of pixels and a capacity of pairs. side: see Pairs."""
    return {
        "point_offset": ((n + 1,), np.uint32),
        "pixel_offset": ((pixels + 1,), np.uint32),
        "pair_pixel": ((pairs,), np.uint32),
        "pair_point_falloff": ((pairs, 2 if side == 1 else 1), np.uint32),
        "pair_key": ((pairs,), np.uint64),
        # used to sort the keys, then for pixel_weight_point of weights.py
        "pair_scratch": ((pairs,), np.uint64),
    }


@replayed
def find_pairs(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    size: tuple[int, int],
    capacity: int = 1,
    times_seen: Array | None = None,
) -> Pairs:
    """Find the fragments in an image of size (height, width), if there are at most `capacity`. Does
    not wait for the device; read_count() downloads their number.

    times_seen: (N,) float32, counts for each point the images in which it has a fragment.
    """
    n, pixels, side = len(points.point_box), size[0] * size[1], points.side
    b.require(pairs_table(n, pixels, capacity, side))
    if not dev.is_cpu:
        b.require({"pixel_count": ((pixels,), np.uint32)})
        dev.fill(b.pixel_count, 0)
    launch_groups(
        dev,
        "raster/pairs",
        "pairs_fill",
        blocks_of(n),
        defines={"LANES": lanes(dev), "BLOCK": BLOCK, **footprint_macros(points.footprint, side)},
        n=n,
        p=capacity,
        is_counted=times_seen is not None,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        point_shape=points.point_shape,
        point_box=points.point_box,
        point_count=points.point_count,
        block_sum=points.block_sum,
        point_offset=b.point_offset,
        pair_pixel=b.pair_pixel,
        pair_point_falloff=b.pair_point_falloff,
        point_key=b.pair_key if dev.is_cpu else b.pair_scratch,
        times_seen=times_seen,
        pixel_count=b.pixel_offset if dev.is_cpu else b.pixel_count,
    )
    if dev.is_cpu:
        _list_by_bucket(dev, b, n, pixels, capacity)
    else:
        _list_by_key(dev, b, pixels, capacity)
    return Pairs(
        b.point_offset,
        b.pixel_offset,
        b.pair_pixel,
        b.pair_point_falloff,
        b.pair_key,
    )


def _list_by_bucket(dev, b, n, pixels, capacity):
    """Sort pair_key, which is listed by point, and write pixel_offset."""
    program = dev.program("raster/lists_by_bucket", BUCKETS=BUCKETS)
    chunks = min(MOST_CHUNKS, dev.info["compute_units"])
    stretch = (-(-pixels // BUCKETS) - 1).bit_length()  # a bucket covers 2^stretch pixels
    shared = {
        "chunks": chunks,
        "stretch": stretch,
        "pair_pixel": b.pair_pixel,
        "bucket_size": dev.scratch("buckets", BUCKETS * chunks, np.uint32),
    }
    filled = {"n": n, "p": capacity, "point_offset": b.point_offset, **shared}
    program.launch("pairs_bucket_sizes", chunks, local=1, **filled)
    keys = {"point_key": b.pair_key, "bucket_key": b.pair_scratch}
    program.launch("pairs_bucket", chunks, local=1, **keys, **filled)
    program.launch(
        "pairs_list",
        ((pixels - 1) >> stretch) + 1,
        local=1,
        hw=pixels,
        bucket_key=b.pair_scratch,
        pixel_offset=b.pixel_offset,
        pair_key=b.pair_key,
        **shared,
    )


def _list_by_key(dev, b, pixels, capacity):
    """Sort the keys of pair_scratch, listed by point, into pair_key, and write pixel_offset."""
    program = dev.program("raster/lists_by_key", RUN=RUN)
    exclusive_scan(dev, b.pixel_count, b.pixel_offset)
    shared = {
        "p": capacity,
        "hw": pixels,
        "pair_pixel": b.pair_pixel,
        "pixel_offset": b.pixel_offset,
    }
    keys, other = b.pair_key, b.pair_scratch
    program.launch("pairs_scatter", capacity, point_key=other, pair_key=keys, **shared)
    program.launch("pairs_sort_runs", capacity, pair_key=keys, sorted=other, **shared)

    def merge(source, target, width, group, least):
        sizes = {"width": width, "group": group, "least": least}
        program.launch(
            "pairs_merge_runs", capacity, sorted=source, pair_key=target, **sizes, **shared
        )

    merge(other, keys, RUN, LONG_LIST, 0)
    if capacity > LONG_LIST:  # the long lists, to the other buffer and back
        merge(keys, other, LONG_LIST, LONG_LIST * RUN, LONG_LIST)
        merge(other, keys, LONG_LIST * RUN, MOST_PAIRS, LONG_LIST)


def capacity_needed(pairs: Pairs) -> int:
    """The capacity of these pairs if all fitted, otherwise a larger one that they fit. Waits until
    their number is known. Raises UserError for more pairs than uint32 can number.
    """
    total = pairs.total
    if total >= MOST_PAIRS:
        raise UserError(
            f"the points of one view cover more than {MOST_PAIRS} pixels in all: "
            "lower --points, raise --downscale, or lower raster.radius"
        )
    return min(grown(pairs.capacity, total), MOST_PAIRS)
