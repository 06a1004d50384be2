"""Sets of tiles, (rows, columns) bool: neighbours, and the same places at other levels."""

import numpy as np
from scipy.ndimage import distance_transform_cdt


def distance(tiles: np.ndarray) -> np.ndarray:
    """(rows, columns) int: how many tiles away, diagonals included, the nearest one that is set is;
    more than any number of them where none is.
    """
    if not tiles.any():
        return np.full(tiles.shape, np.iinfo(np.int32).max)
    return distance_transform_cdt(~tiles, "chessboard")


def grow(tiles: np.ndarray, n: int = 1) -> np.ndarray:
    """(rows, columns) bool: the tiles within n tiles, diagonals included, of those that are set."""
    if n > 2:  # fewer are faster step by step
        return distance(tiles) <= n
    for _ in range(n):
        rows = tiles.copy()
        rows[1:] |= tiles[:-1]
        rows[:-1] |= tiles[1:]
        tiles = rows.copy()
        tiles[:, 1:] |= rows[:, :-1]
        tiles[:, :-1] |= rows[:, 1:]
    return tiles


def halve(tiles: np.ndarray, levels: int = 1) -> np.ndarray:
    """The tiles 2**levels as wide that hold any of those that are set."""
    for _ in range(levels):
        rows = np.logical_or.reduceat(tiles, np.arange(0, tiles.shape[0], 2), axis=0)
        tiles = np.logical_or.reduceat(rows, np.arange(0, tiles.shape[1], 2), axis=1)
    return tiles


def double(tiles: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(rows, columns) = shape bool: the tiles half as wide inside those that are set."""
    return tiles.repeat(2, 0).repeat(2, 1)[: shape[0], : shape[1]]
