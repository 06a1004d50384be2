"""Tiles of 4 x 4 pixels of a feature map: which of them a kernel computes, which hold something,
and copies among them.

A feature map of (height, width) pixels has ceil(height / 4) x ceil(width / 4) tiles, numbered row
by row; the last ones may be cut off by the border.
"""

import weakref
from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

LANES = 16  # channels in one float16
# a tile of outputs of F(4x4, 3x3), and what one pixel is after the network has halved its input
# twice
SIDE = 4


@dataclass(frozen=True)
class Tiles:
    """The tiles of a feature map that a kernel computes.

    size: (height, width) of the feature map. number: of computed tiles. list: (3 + number,) int32:
    height, width, number, the tiles ascending. count: (rows, columns) float32: how many tiles each
    one stands for where sums are taken over the whole feature map, itself among them; 0 for those
    that are not computed.
    """

    size: tuple
    number: int
    list: Array
    count: Array


_all_tiles = weakref.WeakKeyDictionary()  # {device: {(height, width): Tiles}}


def grid_shape(height, width):
    """(rows, columns) of the tiles of a feature map."""
    return -(-height // SIDE), -(-width // SIDE)


def some_tiles(dev, size, count):
    """Tiles of a feature map of `size` = (height, width) from their count (rows, columns), numpy.

    Raises ValueError when there are none.
    """
    chosen = np.flatnonzero(count)
    if not len(chosen):
        raise ValueError(f"no tile of {size} chosen")
    return Tiles(
        size,
        len(chosen),
        dev.upload(np.concatenate([(*size, len(chosen)), chosen]), np.int32),
        dev.upload(count, np.float32),
    )


def all_tiles(dev, height, width):
    """Every tile of a feature map, made once for each size."""
    made = _all_tiles.setdefault(dev, {})
    if (height, width) not in made:
        made[height, width] = some_tiles(dev, (height, width), np.ones(grid_shape(height, width)))
    return made[height, width]


def checked_tiles(dev, tiles, height, width):
    """`tiles`, or all if None. Raises ValueError for those of a feature map of another size."""
    if tiles is None:
        return all_tiles(dev, height, width)
    if tiles.size != (height, width):
        raise ValueError(f"tiles of {tiles.size} for a feature map of {(height, width)}")
    return tiles


def tiles_find(dev, x, background):
    """(rows, columns) numpy bool: the tiles of x (H, W, C) float32 in which some value is not
    `background`.
    """
    return _flags(dev, "tiles_find", x, background=background)


def tiles_compare(dev, x, source):
    """(rows, columns) numpy bool: the tiles of x (H, W, C) float32 whose bits are not those of the
    tile that `source` names.

    source: (rows, columns) numpy integers; a tile and its source have the same shape.
    """
    return _flags(dev, "tiles_compare", x, source=dev.upload(source, np.int32))


def tiles_copy(dev, x, source, chosen):
    """Make the chosen tiles of x (H, W, C) float32 copies of the tiles that `source` names, which
    are not chosen themselves.

    source: (rows, columns) numpy integers; chosen: (rows, columns) numpy bool. A tile and its
    source have the same shape.
    """
    to = np.flatnonzero(chosen)
    if not len(to):
        return
    h, w, c = x.shape
    dev.program("layers/tiles").launch(
        "tiles_copy",
        (-(-c // LANES), SIDE * SIDE, len(to)),
        local=(1, SIDE * SIDE, 4),
        h=h,
        w=w,
        c=c,
        n=len(to),
        from_to=dev.upload(np.stack([source.ravel()[to], to]), np.int32),
        x=x,
    )


def _flags(dev, kernel, x, **arguments):
    h, w, c = x.shape
    rows, columns = grid_shape(h, w)
    flags = dev.empty((rows, columns), np.int32)
    output = {"tiles_find": "found", "tiles_compare": "differs"}[kernel]
    dev.program("layers/tiles").launch(
        kernel, rows * columns, h=h, w=w, c=c, x=x, **{output: flags}, **arguments
    )
    return flags.get() != 0
