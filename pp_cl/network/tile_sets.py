"""Sets of tiles, (rows, columns) bool: neighbours, and the same places at other levels."""

import numpy as np


def grow(tiles: np.ndarray, n: int = 1) -> np.ndarray:
    """(rows, columns) bool: the tiles within n tiles, diagonals included, of those that are set."""
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
        rows, columns = tiles.shape
        padded = np.pad(tiles, ((0, rows % 2), (0, columns % 2)))
        tiles = padded.reshape(-1, 2, padded.shape[1] // 2, 2).any((1, 3))
    return tiles


def double(tiles: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(rows, columns) = shape bool: the tiles half as wide inside those that are set."""
    return tiles.repeat(2, 0).repeat(2, 1)[: shape[0], : shape[1]]
