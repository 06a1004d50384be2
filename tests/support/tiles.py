"""Tiles of feature maps that a kernel computes."""

from pp_cl.engine.layers.tiles import MAP_TILE, grid_shape


def pixels_of(tile_mask, height, width):
    """Expand an array of tiles, (rows, columns), to pixels, (height, width)."""
    return tile_mask.repeat(MAP_TILE, 0).repeat(MAP_TILE, 1)[:height, :width]


def random_counts(rng, height, width):
    """(rows, columns) of random 0 (half of them), 1 and 7; at least one is not 0."""
    counts = rng.choice([0, 0, 1, 7], grid_shape(height, width))
    counts[-1, -1] = 7
    return counts
