"""Skips background in the U-Net: plans which 4x4 tiles of each feature map are computed, and which
are copies of a computed one.

Where the network sees nothing but background, its output depends only on the distance from the
borders of the image, which it sees as zeros. So the tiles that see only background fall into
classes of equal tiles: one class inside, and one for each place near a border. One tile of each
class is computed, its representative; the others are copied from it where a layer needs them. In
sums over the image, for the gradients of weights, a representative counts once for each tile of its
class. The results are the same except for rounding: Winograd's transforms mix the last bits of a
tile.

The backward pass has its own classes: it groups the tiles where the network saw only background and
the image's gradient equals that of the representative.

Feature maps have the names of UNet's arrays: those of layers, and gradient_of(name). Sets of tiles
are (rows, columns) bool.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pyopencl.array import Array
from scipy.ndimage import distance_transform_cdt

from pp_cl.engine.device.buffers import PackedArrays
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.tiles import (
    MAP_TILE,
    Tiles,
    all_tiles,
    copy_list,
    grid_shape,
    tile_arrays,
    tiles_copy,
)
from pp_cl.engine.network.layers import Layer, convolutions, gradient_of, levels_of

# How far the loss reaches, in pixels: from a pixel of the image or target to the gradients that
# depend on it, through two SSIM windows; and, together with the network, from the image's border.
LOSS_RADIUS, LOSS_BORDER = 10, 48


def distance(tiles: np.ndarray) -> np.ndarray:
    """(rows, columns) int: the distance in tiles to the nearest tile that is set, with diagonals
    counting as 1 (chessboard distance); the largest int32 if none is set.
    """
    if not tiles.any():
        return np.full(tiles.shape, np.iinfo(np.int32).max)
    return distance_transform_cdt(~tiles, "chessboard")


def grow(tiles: np.ndarray, n: int = 1) -> np.ndarray:
    """The tiles within n tiles of a set tile, diagonals included."""
    if n > 2:  # for smaller n, single steps are faster
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
    """The tiles 2**levels as wide that contain a set tile."""
    for _ in range(levels):
        rows = np.logical_or.reduceat(tiles, np.arange(0, tiles.shape[0], 2), axis=0)
        tiles = np.logical_or.reduceat(rows, np.arange(0, tiles.shape[1], 2), axis=1)
    return tiles


def double(tiles: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(rows, columns) = shape bool: the tiles half as wide inside the set tiles."""
    return tiles.repeat(2, 0).repeat(2, 1)[: shape[0], : shape[1]]


def tiles_in_reach(found: np.ndarray, size: tuple[int, int], offset: tuple[int, int]) -> np.ndarray:
    """The tiles of an image of `size` = (height, width) where the gradient of the loss may differ
    from that of background over a white target: those within the loss's reach of a tile of the
    target that is not white. plan_backward() adds the borders.

    found: (?, ?) bool, the target's tiles that are not all white. offset: (left, top) of the target
    in the image, less than a tile.
    """
    tiles = np.zeros(grid_shape(*size), bool)
    tiles[: found.shape[0], : found.shape[1]] = found
    return grow(tiles, _tiles_of(LOSS_RADIUS + max(offset)))


def _tiles_of(pixels):
    """How many tiles a number of pixels reaches."""
    return -(-pixels // MAP_TILE)


def receptive_radius(layers: list[Layer]) -> dict[str, int]:
    """{name: pixels}: the radius of the receptive field of each layer's output in the input x."""
    radius = {"x": 0}
    for layer in layers:
        radius[layer.name] = max(radius[name] for name in layer.inputs) + _forward_radius(layer)
    return radius


def gradient_radius(layers: list[Layer]) -> dict[str, int]:
    """{name: pixels}: for the gradients of x and of each layer's output, the radius of the
    receptive field in the image's gradient. Gradients computed in one launch get the largest of
    their radii.
    """
    radius = dict.fromkeys([gradient_of(layer.name) for layer in layers], 0)
    for layer in reversed(layers):
        reached = radius[gradient_of(layer.name)] + _backward_radius(layer)
        for grad in map(gradient_of, layer.inputs):
            radius[grad] = max(radius.get(grad, 0), reached)
    for layer in layers:
        grads = [gradient_of(name) for name in layer.inputs]
        radius |= dict.fromkeys(grads, max(radius[grad] for grad in grads))
    return radius


def _forward_radius(layer):
    """Radius of the receptive field of one layer, in pixels of the image."""
    if layer.kind == "conv":
        return layer.kernel_size // 2 << layer.level
    return {"gate": 0, "pool": 1, "upsample": 2}[layer.kind] << layer.level >> 1


def _backward_radius(layer):
    """The same radius for the input's gradient in the output's gradient."""
    if layer.kind == "conv":
        return _forward_radius(layer)
    return {"gate": 0, "pool": 0, "upsample": 2}[layer.kind] << layer.level


def _read_forward(layer, computed, shape):
    """(rows, columns) = shape bool: the tiles of an input that a layer reads to compute the given
    tiles of its output.
    """
    if layer.kind == "pool":
        return double(computed, shape)
    if layer.kind == "upsample":
        return halve(grow(computed))
    return grow(computed) if layer.kernel_size > 1 else computed


def _read_backward(layer, computed, shape):
    """(rows, columns) = shape bool: the tiles of the output's gradient that a layer reads to
    compute the given tiles of an input's gradient.
    """
    if layer.kind == "pool":
        return halve(computed)
    if layer.kind == "upsample":
        return grow(double(computed, shape))
    return _read_forward(layer, computed, shape)


@dataclass(frozen=True)
class TileMap:
    """For each tile of a feature map, the computed tile with the same values.

    source: (rows, columns) int, the number of that computed tile: the tile's own, or its class's
    representative. computed: (rows, columns) bool.
    """

    source: np.ndarray
    computed: np.ndarray

    def count(self) -> np.ndarray:
        """(rows, columns) int: for how many tiles each computed tile stands, itself included; 0 for
        copies.
        """
        count = np.bincount(self.source.ravel(), minlength=self.source.size)
        return count.reshape(self.source.shape)


def map_tiles(size: tuple[int, int], level: int, active: np.ndarray, border: int) -> TileMap:
    """The TileMap of a feature map at a level, which has the height and width of the image's `size`
    divided by 2**level: `active` tiles are always computed, all others are grouped into classes of
    equal tiles. border: a tile may depend on its distance from the border of the image if it is
    within this many tiles of level 0.
    """
    rows, columns = (_classes(length, level, border * MAP_TILE) for length in size)
    classes = (rows[:, None] * (columns.max() + 1) + columns).ravel()
    numbers = np.arange(active.size)
    idle, source = np.flatnonzero(~active), numbers.copy()
    representative = np.zeros(classes.max() + 1, int)
    # assigned backwards, so that the first tile of a class represents it
    representative[classes[idle[::-1]]] = idle[::-1]
    source[idle] = representative[classes[idle]]
    return TileMap(source.reshape(active.shape), (source == numbers).reshape(active.shape))


def _classes(length, level, border):
    """Classes of the tiles along one axis of the image: each tile near a border has its own."""
    side = MAP_TILE << level
    start = np.arange(0, length, side)
    near = (start < border) | (start + side > length - border)
    return np.where(near, np.arange(len(start)), len(start))


@dataclass
class TilePlan:
    """Which tiles of each feature map a pass computes, and which it then copies from them.

    tiles: {name: Tiles} to compute. copies: {name: (from_to, number) for tiles_copy()}; empty if
    all tiles are computed. computed_fraction: the share of the network's multiplications that
    remains in a forward pass. For the backward pass after it, maps: {name: TileMap} of the layers'
    outputs; active: (rows, columns) bool, the tiles of the image where it starts.
    """

    tiles: dict[str, Tiles]
    copies: dict[str, tuple[Array, int]] = field(default_factory=dict)
    computed_fraction: float = 1.0
    maps: dict[str, TileMap] = field(default_factory=dict)
    active: Any = None

    def copy_tiles(self, dev: Device, name: str, array: Array) -> None:
        """Copy the tiles of a feature map that are needed but were not computed."""
        if name in self.copies:
            tiles_copy(dev, array, *self.copies[name])


def plan_all(dev: Device, layers: list[Layer], size: tuple[int, int]) -> TilePlan:
    """The plan for images of `size` = (height, width) that computes all tiles in both passes."""
    levels = levels_of(layers)
    tiles = {n: all_tiles(dev, size[0] >> n, size[1] >> n) for n in set(levels.values())}
    return TilePlan({name: tiles[level] for name, level in levels.items()})


def plan_forward(
    layers: list[Layer],
    size: tuple[int, int],
    active: np.ndarray,
    gradient_tiles: np.ndarray | None,
    lists: PackedArrays,
    *,
    most: float,
) -> TilePlan | None:
    """Plan the forward pass over an image of `size` = (height, width), where x differs from the
    background in the tiles `active`; None if more than `most` of the multiplications remain.

    gradient_tiles: from tiles_in_reach(); None: all tiles. lists: holds the lists of tiles on the
    device, until it is given others.
    """
    radius, last = receptive_radius(layers), layers[-1].name
    affected = grow(active, _tiles_of(radius[last] + LOSS_RADIUS))
    del radius["x"]  # the caller gives x
    maps = _map_all(layers, size, active, radius)
    count = {c.name: c.multiplications(*size) for c in convolutions(layers)}
    done = sum(n * maps[name].computed.mean() for name, n in count.items()) / sum(count.values())
    if done > most:
        return None
    needed = {name: np.zeros_like(of_layer.computed) for name, of_layer in maps.items()}
    for layer in layers:
        for name in needed.keys() & layer.inputs:
            needed[name] |= _read_forward(layer, maps[layer.name].computed, needed[name].shape)
    needed[last][:] = True
    plan = _send(levels_of(layers), size, maps, needed, maps, lists)
    plan.computed_fraction, plan.maps = done, maps
    plan.active = affected | (True if gradient_tiles is None else gradient_tiles)
    return plan


def plan_backward(
    layers: list[Layer], size: tuple[int, int], forward: TilePlan, lists: PackedArrays
) -> TilePlan:
    """Plan the backward pass after a forward pass that skipped tiles. Also copies tiles of forward
    outputs that it reads, as inputs of layers and as masks of ReLUs. lists: see plan_forward().
    """
    border = _tiles_of(max(LOSS_BORDER, receptive_radius(layers)[layers[-1].name]))
    maps = _map_all(layers, size, forward.active, gradient_radius(layers), border)
    needed = {name: np.zeros_like(of_map.computed) for name, of_map in maps.items()}
    for layer in layers:
        grad = gradient_of(layer.name)
        for name in layer.inputs:
            at_input = maps[gradient_of(name)].computed
            needed[grad] |= _read_backward(layer, at_input, needed[grad].shape)
            if layer.reads_input_backward and name != "x":
                reads = _read_forward(layer, maps[grad].computed, at_input.shape) | at_input
                needed[name] = needed.get(name, False) | reads
    needed[gradient_of("x")][:] = True
    return _send(levels_of(layers), size, maps, needed, forward.maps | maps, lists)


def _map_all(layers, size, active, radius, border=0):
    """{name: TileMap} of feature maps in an image of `size`; names may share a TileMap.

    radius: {name: pixels}: tiles within that distance of the `active` tiles of the image are
    computed; tiles within that distance plus `border` tiles of the image's border are classes of
    their own.
    """
    levels, away, made = levels_of(layers), distance(active), {}
    keys = {name: (levels[name], _tiles_of(pixels)) for name, pixels in radius.items()}
    for level, n in set(keys.values()):
        made[level, n] = map_tiles(size, level, halve(away <= n, level), border + n)
    return {name: made[key] for name, key in keys.items()}


def _send(levels, size, maps, needed, copied, lists):
    """Send the lists of a TilePlan to the device, and return the plan.

    maps: {name: TileMap} of the maps that the pass computes. needed: {name: (rows, columns) bool}
    of the tiles that it reads. copied: {name: TileMap} of all names in `needed`.
    """
    distinct = {id(of_map): (levels[name], of_map) for name, of_map in maps.items()}
    rows, values, tiles = [], [], {}
    for level, of_map in distinct.values():
        rows += [((3 + of_map.source.size,), np.int32), (of_map.source.shape, np.float32)]
        values += tile_arrays((size[0] >> level, size[1] >> level), of_map.count())
    for name, chosen in needed.items():
        rows.append(((chosen.size, 2), np.int32))
        values.append(copy_list(copied[name].source, chosen & ~copied[name].computed))
    arrays = iter(lists.send(rows, values))
    for key, (level, of_map) in distinct.items():
        here, number = (size[0] >> level, size[1] >> level), int(of_map.computed.sum())
        tiles[key] = Tiles(here, number, list=next(arrays), count=next(arrays))
    numbers = map(len, values[2 * len(distinct) :])
    return TilePlan(
        {name: tiles[id(of_map)] for name, of_map in maps.items()},
        {name: copy for name, *copy in zip(needed, arrays, numbers, strict=True)},
    )
