"""Tiles of 4 x 4 pixels of a feature map: lists of the tiles that a kernel computes, tests for
tiles that are not background, and copies from tile to tile.

A feature map of (height, width) pixels has ceil(height / 4) x ceil(width / 4) tiles, numbered row
by row; the border may cut off the last ones.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Pending, read_later
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import channel_ranges, lanes

VECTOR = 16  # channels in one float16
# pixels: F(4x4, 3x3) outputs this many, and the network's two halvings make one pixel of them
MAP_TILE = 4


@dataclass(frozen=True)
class Tiles:
    """The tiles of a feature map that a kernel computes.

    size: (height, width) of the feature map. number: how many tiles are computed. list: (?,) int32:
    height, width, number, then the computed tiles, ascending. count: (rows, columns) float32: how
    often a computed tile counts in sums over the whole feature map, for itself and its copies; 0
    for tiles that are not computed.
    """

    size: tuple[int, int]
    number: int
    list: Array
    count: Array

    def check(self, size: tuple[int, int]) -> None:
        """Raise ValueError if the feature map has another size; kernels that only read the list
        would write outside the map.
        """
        if self.size != size:
            raise ValueError(f"tiles of {self.size} for a feature map of {size}")


def grid_shape(height: int, width: int) -> tuple[int, int]:
    """(rows, columns) of the tiles of a feature map."""
    return -(-height // MAP_TILE), -(-width // MAP_TILE)


def some_tiles(dev: Device, size: tuple[int, int], count: np.ndarray) -> Tiles:
    """Tiles of a feature map of `size` = (height, width) from their count (rows, columns).

    Raises ValueError if no count is above 0.
    """
    return Tiles(size, int(np.count_nonzero(count)), *map(dev.upload, tile_arrays(size, count)))


def tile_arrays(size: tuple[int, int], count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tiles.list and Tiles.count as numpy arrays. Raises ValueError like some_tiles()."""
    chosen = np.flatnonzero(count)
    if not len(chosen):
        raise ValueError(f"no tile of {size} chosen")
    return np.array([*size, len(chosen), *chosen], np.int32), count.astype(np.float32)


def all_tiles(dev: Device, height: int, width: int) -> Tiles:
    """Every tile of a feature map."""
    return some_tiles(dev, (height, width), np.ones(grid_shape(height, width)))


def tiles_find(
    dev: Device,
    x: Array,
    background: float,
    convert: Callable[[np.ndarray], np.ndarray] = lambda tiles: tiles,
) -> Pending[np.ndarray]:
    """(rows, columns) bool: the tiles of x (H, W, C) float32 that are not all `background`;
    convert() of them.
    """
    h, w, c = x.shape
    return _flags(dev, "tiles_find", (h, w), convert, c=c, background=background, x=x)


def tiles_with(pixels: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: the tiles in which any of the pixels (H, W) bool is set."""
    (height, width), (rows, columns) = pixels.shape, grid_shape(*pixels.shape)
    whole = np.pad(pixels, ((0, rows * MAP_TILE - height), (0, columns * MAP_TILE - width)))
    return np.logical_or.reduce(whole.reshape(rows, MAP_TILE, columns, MAP_TILE), (1, 3))


def copy_list(source: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(n, 2) int32 for tiles_copy(): for each of the n chosen tiles, the number of its source and
    its own.

    source: (rows, columns) integers; chosen: (rows, columns) bool.
    """
    to = np.flatnonzero(chosen)
    return np.stack([source.ravel()[to], to], axis=1).astype(np.int32)


def tiles_copy(dev: Device, x: Array, from_to: Array, n: int) -> None:
    """Copy tiles of x (H, W, C) float32 to others, by the first n rows of from_to, (?, 2) int32,
    see copy_list(); no tile is both read and written. A tile and its source have the same shape.
    """
    h, w, c = x.shape
    size, work_group = channel_ranges(dev, n, MAP_TILE * MAP_TILE, c)
    _program(dev).launch("tiles_copy", size, work_group, h=h, w=w, c=c, n=n, from_to=from_to, x=x)


def _program(dev):
    return dev.program("layers/tiles", LANES=lanes(dev))


def _flags(dev, kernel, size, convert=lambda tiles: tiles, **arguments):
    shape = grid_shape(*size)
    tiles = shape[0] * shape[1]
    flags = dev.scratch("tile flags", tiles, np.int32)[:tiles]
    _program(dev).launch(
        kernel, tiles, h=size[0], w=size[1], flags=flags.reshape(shape), **arguments
    )
    return read_later(dev, flags, convert=lambda values: convert(values.reshape(shape) != 0))
