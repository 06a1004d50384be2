"""Finds the pairs of a point and a tile of the image that it may cover, and lists them by tile,
sorted by depth: the order in which every pixel of the tile sees its points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table, grown
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, launch_groups, replayed
from pp_cl.engine.device.scan import BLOCK, exclusive_scan, read_total
from pp_cl.engine.raster.project import ProjectedPoints, tiles_of
from pp_cl.errors import UserError

MOST_PAIRS = 2**32 - 1  # pairs are numbered by uint32
MOST_CHUNKS = 64  # most chunks of the points; CPUs list them in parallel
MOST_COUNTS = 2**22  # numbers of pairs by chunk and tile
RUN = 64  # keys that GPUs rank by comparing all with all; runs of this length are merged
LONG_LIST = RUN * RUN  # GPUs merge lists of more keys than this in several passes
TILE_SAMPLES = 256  # samples of a tile, 16 x 16; GPUs walk with a work-item for each


@dataclass
class Pairs:
    """The pairs of a view of N points, valid until the next ones are found. Tiles are numbered row
    by row.

    The arrays have a capacity of P pairs. If the view has more, they must not be read: find the
    pairs again with more capacity (capacity_needed()).

    size: (height, width) of the image. tiles: (rows, columns). tile_offset: (TILES+1,) uint32, tile
    t owns keys tile_offset[t] to tile_offset[t+1]. pair_key: (P,) uint64, depth bits << 32 | point,
    sorted within each tile. point_offset: (N+1,) uint32, point i owns pairs point_offset[i] to
    point_offset[i+1], a tile each, row by row; None if not asked for. shown: (P,) uint64, scratch
    memory that blend_weights() fills. count: the number of pairs, downloaded by read_count().
    """

    size: tuple[int, int]
    tiles: tuple[int, int]
    tile_offset: Array
    pair_key: Array
    point_offset: Array | None
    shown: Array
    count: Any = None

    def read_count(self, dev: Device) -> None:
        """Enqueue the download of the number of pairs."""
        self.count = read_total(dev, self.tile_offset)

    @property
    def total(self) -> int:
        """The number of pairs; waits until it is known."""
        return self.count.get()

    @property
    def capacity(self) -> int:
        """P."""
        return len(self.pair_key)

    @property
    def pixels(self) -> int:
        """HW."""
        return self.size[0] * self.size[1]


def pairs_table(
    dev: Device,
    n: int,
    size: tuple[int, int],
    pairs: int,
    supersampling: int = 1,
    by_point: bool = False,
) -> Table:
    """The buffers for n points, an image of size (height, width) and a capacity of pairs.
    supersampling: see ProjectedPoints. by_point: with point_offset.
    """
    rows, columns = tiles_of(size, supersampling)
    tiles = rows * columns
    table: Table = {
        "tile_next": ((_chunks(dev, tiles) if dev.is_cpu else 1, tiles), np.uint32),
        "tile_size": ((tiles,), np.uint32),
        "tile_offset": ((tiles + 1,), np.uint32),
        "pair_key": ((pairs,), np.uint64),
        # used to sort the keys, then for the points that show
        "shown": ((pairs,), np.uint64),
    }
    if not dev.is_cpu:
        table["pair_tile"] = (pairs,), np.uint32
    if by_point:
        table["point_offset"] = (n + 1,), np.uint32
    return table


def _chunks(dev, tiles):
    return max(1, min(MOST_CHUNKS, 2 * dev.info["compute_units"], MOST_COUNTS // tiles))


@replayed
def find_pairs(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    size: tuple[int, int],
    capacity: int = 1,
    times_seen: Array | None = None,
    by_point: bool = False,
) -> Pairs:
    """Find the pairs in an image of size (height, width), if there are at most `capacity`. Does not
    wait for the device; read_count() downloads their number.

    times_seen: (N,) float32, counts for each point the images in which its box lies. by_point: also
    number the pairs by point.
    """
    n, tiles = len(points.point_count), tiles_of(size, points.supersampling)
    b.require(pairs_table(dev, n, size, capacity, points.supersampling, by_point))
    macros = {"LANES": lanes(dev), "BLOCK": BLOCK, **points.macros()}
    program = dev.program("raster/pairs", **macros)
    count = tiles[0] * tiles[1]
    chunks = len(b.tile_next) if dev.is_cpu else n
    of_points: dict[str, Any] = {
        "n": n,
        "chunks": chunks,
        "columns": tiles[1],
        "tiles": count,
        "point_record": points.point_record,
        "point_count": points.point_count,
        "block_sum": points.block_sum,
        "tile_next": b.tile_next,
    }
    dev.fill(b.tile_next, 0)
    program.launch("pairs_count", chunks, **of_points)
    rows = {"rows": len(b.tile_next), "tiles": count}
    program.launch("pairs_sum", count, tile_next=b.tile_next, tile_size=b.tile_size, **rows)
    exclusive_scan(dev, b.tile_size, b.tile_offset)
    program.launch(
        "pairs_fill",
        chunks,
        p=capacity,
        is_counted=times_seen is not None,
        tile_offset=b.tile_offset,
        pair_key=b.pair_key,
        pair_tile=b.tile_size if dev.is_cpu else b.pair_tile,
        times_seen=times_seen,
        **of_points,
    )
    shared: dict[str, Any] = {"tiles": count, "p": capacity, "tile_offset": b.tile_offset}
    if dev.is_cpu:
        program.launch("pairs_sort", count, 1, pair_key=b.pair_key, other=b.shown, **shared)
    else:
        _sort_by_key(dev, b, capacity, shared)
    if by_point:
        exclusive_scan(dev, points.point_count, b.point_offset)
    arrays = b.tile_offset, b.pair_key, b.point_offset if by_point else None, b.shown
    return Pairs(size, tiles, *arrays)


def _sort_by_key(dev, b, capacity, shared):
    """Sort the keys of b.pair_key within each tile, on GPUs."""
    program = dev.program("raster/lists_by_key", RUN=RUN)
    shared = {"pair_tile": b.pair_tile, **shared}
    keys, other = b.pair_key, b.shown

    def merge(source, target, width, group, least):
        sizes = {"width": width, "group": group, "least": least}
        program.launch(
            "pairs_merge_runs", capacity, sorted=source, pair_key=target, **sizes, **shared
        )

    program.launch("pairs_sort_runs", capacity, pair_key=keys, sorted=other, **shared)
    merge(other, keys, RUN, LONG_LIST, 0)
    if capacity > LONG_LIST:  # the long lists, to the other buffer and back
        merge(keys, other, LONG_LIST, LONG_LIST * RUN, LONG_LIST)
        merge(other, keys, LONG_LIST * RUN, MOST_PAIRS, LONG_LIST)


def launch_tiles(
    dev: Device, name: str, kernel: str, points: ProjectedPoints, pairs: Pairs, **arguments: Any
) -> None:
    """Launch a kernel of cl/<name>.cl that walks along the tiles' lists, as cl/raster/tiles.h
    describes. arguments: by parameter name, apart from those that all of them have; defines: macros
    of the program.
    """
    samples, tiles = points.supersampling**2, pairs.tiles[0] * pairs.tiles[1]
    defines = {"LANES": lanes(dev, samples), **points.macros(), **arguments.pop("defines", {})}
    launch_groups(
        dev,
        name,
        kernel,
        tiles,
        most=TILE_SAMPLES // samples,
        defines=defines,
        tiles=tiles,
        camera=points.camera_buffer,
        point_record=points.point_record,
        tile_offset=pairs.tile_offset,
        shown=pairs.shown,
        **arguments,
    )


def capacity_needed(pairs: Pairs) -> int:
    """The capacity of these pairs if all fitted, otherwise a larger one that they fit. Waits until
    their number is known. Raises UserError for more pairs than uint32 can number.
    """
    total = pairs.total
    if total >= MOST_PAIRS:
        raise UserError(
            f"the points of one view touch more than {MOST_PAIRS} tiles in all: "
            "lower --points, raise --downscale, or lower raster.radius"
        )
    return min(grown(pairs.capacity, total), MOST_PAIRS)
