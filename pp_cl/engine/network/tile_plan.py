"""Skips background in the U-Net: plans which 4x4 tiles of each feature map are computed, and which
are copies of a computed one.

Where the network sees nothing but background, its output depends only on the distance from the
borders of the image, which it sees as zeros. So the tiles that see only background fall into
classes of equal ones: one class inside, one for each place near a border. One tile of each class is
computed, its representative; the others are copies of it, made where a layer needs them. In the
sums over the image, the gradients of weights, a representative counts as often as its class has
tiles. The results are the same but for rounding: Winograd's transforms mix the last bits of a tile.

The backward pass has classes of its own: of the tiles where the network saw only background, those
whose gradient of the image is their representative's.

Feature maps have the names of UNet's arrays: those of the layers, and gradient_of() them. Sets of
tiles are (rows, columns) bool.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pyopencl.array import Array
from scipy.ndimage import distance_transform_cdt

from pp_cl.engine.device.buffers import PackedArrays
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.tiles import (
    SIDE,
    Tiles,
    all_tiles,
    all_tiles_buffers,
    copy_list,
    grid_shape,
    tile_arrays,
    tiles_copy,
)
from pp_cl.engine.network.layers import Layer, convolutions, gradient_of, levels_of

# How far the loss sees, in pixels: from a target's pixel to the gradients that depend on it, by
# two of SSIM's windows; and from the image's border, together with the network.
LOSS_RADIUS, LOSS_BORDER = 10, 48


def distance(tiles: np.ndarray) -> np.ndarray:
    """(rows, columns) int: the distance to the nearest tile that is set, in tiles, diagonals
    counting as 1 (chessboard distance); the largest int32 if none is set.
    """
    if not tiles.any():
        return np.full(tiles.shape, np.iinfo(np.int32).max)
    return distance_transform_cdt(~tiles, "chessboard")


def grow(tiles: np.ndarray, n: int = 1) -> np.ndarray:
    """The tiles within n tiles, diagonals included, of those that are set."""
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


def gradient_tiles(found: np.ndarray, size: tuple[int, int], offset: tuple[int, int]) -> np.ndarray:
    """The tiles of an image of `size` = (height, width) where the gradient of the loss may differ
    from that of background over a white target: those within the loss's reach of a tile of the
    target that is not white. Borders are left to BackwardPlan.

    found: (?, ?) bool, the target's tiles that are not all white. offset: (left, top) of the target
    in the image, less than a tile.
    """
    tiles = np.zeros(grid_shape(*size), bool)
    tiles[: found.shape[0], : found.shape[1]] = found
    return grow(tiles, _tiles_of(LOSS_RADIUS + max(offset)))


def _tiles_of(pixels):
    """How many tiles so many pixels reach."""
    return -(-pixels // SIDE)


def receptive_radius(layers: list[Layer]) -> dict[str, int]:
    """{name: pixels}: radius of the receptive field of each layer's output in the input x."""
    radius = {"x": 0}
    for layer in layers:
        radius[layer.name] = max(radius[name] for name in layer.inputs) + _forward_radius(layer)
    return radius


def gradient_radius(layers: list[Layer]) -> dict[str, int]:
    """{name: pixels}: radius of the receptive field, in the image's gradient, of the gradient of
    each layer's output and of x.
    """
    radius = dict.fromkeys([gradient_of(layer.name) for layer in layers], 0)
    for layer in reversed(layers):
        reached = radius[gradient_of(layer.name)] + _backward_radius(layer)
        for grad in map(gradient_of, layer.inputs):
            radius[grad] = max(radius.get(grad, 0), reached)
    return radius


def _forward_radius(layer):
    """Radius of the receptive field of one layer, in pixels of the image."""
    if layer.kind == "conv":
        return layer.kernel_size // 2 << layer.level
    return {"gate": 0, "pool": 1, "upsample": 2}[layer.kind] << layer.level >> 1


def _backward_radius(layer):
    """The same from the gradient of the output to the gradient of the input."""
    if layer.kind == "conv":
        return _forward_radius(layer)
    return {"gate": 0, "pool": 0, "upsample": 2}[layer.kind] << layer.level


def _read_forward(layer, computed, shape):
    """(rows, columns) = shape bool: tiles of an input that the computed tiles of the output
    read.
    """
    if layer.kind == "pool":
        return double(computed, shape)
    if layer.kind == "upsample":
        return halve(grow(computed))
    return grow(computed) if layer.kernel_size > 1 else computed


def _read_backward(layer, computed, shape):
    """(rows, columns) = shape bool: tiles of the gradient of the output that the computed tiles of
    an input's gradient read.
    """
    if layer.kind == "pool":
        return halve(computed)
    if layer.kind == "upsample":
        return grow(double(computed, shape))
    return _read_forward(layer, computed, shape)


@dataclass(frozen=True)
class TileMap:
    """The tiles of one feature map of `size` = (height, width).

    source: (rows, columns) int, the number of the computed tile that has the same values: the
    tile's own, or its class's representative.
    """

    size: tuple[int, int]
    source: np.ndarray

    @cached_property
    def computed(self) -> np.ndarray:
        """(rows, columns) bool."""
        return self.source == np.arange(self.source.size).reshape(self.source.shape)

    def count(self) -> np.ndarray:
        """(rows, columns) int: how many tiles each one stands for, itself among them; 0 for
        copies.
        """
        count = np.bincount(self.source.ravel(), minlength=self.source.size)
        return count.reshape(self.source.shape)


def map_tiles(size: tuple[int, int], level: int, active: np.ndarray, border: int) -> TileMap:
    """TileMap of a feature map in an image of `size` = (height, width), whose height and width are
    divided by 2**level: `active` tiles are always computed, all others are grouped into classes of
    equal tiles. border: tiles of level 0 from the border of the image within which a tile may
    depend on its distance from it.
    """
    rows, columns = (_classes(length, level, border * SIDE) for length in size)
    classes = (rows[:, None] * (columns.max() + 1) + columns).ravel()
    idle, source = np.flatnonzero(~active), np.arange(active.size)
    representative = np.zeros(classes.max() + 1, int)
    # assigned backwards, so that the first tile of a class remains
    representative[classes[idle[::-1]]] = idle[::-1]
    source[idle] = representative[classes[idle]]
    return TileMap((size[0] >> level, size[1] >> level), source.reshape(active.shape))


def _classes(length, level, border):
    """Classes of the tiles along one axis of the image: each tile near a border is its own."""
    side = SIDE << level
    start = np.arange(0, length, side)
    near = (start < border) | (start + side > length - border)
    return np.where(near, np.arange(len(start)), len(start))


class AllTiles:
    """The plan that skips nothing: a pass that computes all tiles."""

    def __init__(self, dev: Device, size: tuple[int, int], layers: list[Layer]):
        levels = levels_of(layers)
        tiles = {n: all_tiles(dev, size[0] >> n, size[1] >> n) for n in set(levels.values())}
        self._tiles = {name: tiles[level] for name, level in levels.items()}
        self._tiles |= {gradient_of(name): of_level for name, of_level in self._tiles.items()}

    def tiles(self, name: str) -> Tiles:
        """The tiles of a feature map to compute."""
        return self._tiles[name]

    def fill_copies(self, name: str, array: Array) -> None:
        """Nothing: there are no copies."""

    def backward(self, arrays: dict[str, Array], lists: PackedArrays) -> AllTiles:
        """The backward pass after this forward pass."""
        return self


class TilePlan:
    """A pass that computes some tiles of each feature map.

    size: (height, width) of the image. active: the tiles of the image where the pass starts.
    radius: {name: pixels} of the feature maps that the pass computes: tiles within that distance of
    `active` are computed; within `border` tiles more than that from the image's border they are
    classes of their own. maps: {name: TileMap}. needed: {name: tiles that a layer reads}.
    """

    def __init__(
        self,
        dev: Device,
        layers: list[Layer],
        size: tuple[int, int],
        active: np.ndarray,
        *,
        radius: dict[str, int],
        border: int = 0,
    ):
        self.dev, self.layers, self.size = dev, layers, size
        levels, away, made = levels_of(layers), distance(active), {}
        levels |= {gradient_of(name): level for name, level in levels.items()}
        self.maps: dict[str, TileMap] = {}
        for name, pixels in radius.items():
            level, n = key = levels[name], _tiles_of(pixels)
            if key not in made:
                made[key] = map_tiles(size, level, halve(away <= n, level), border + n)
            self.maps[name] = made[key]
        self.needed = {name: np.zeros_like(m.computed) for name, m in self.maps.items()}
        self._tiles: dict[int, Tiles] = {}  # {id of a TileMap: its tiles}
        self._copies: dict[str, tuple[Array, int]] = {}  # {name: arguments of tiles_copy()}

    def upload(self, lists: PackedArrays, copied: dict[str, TileMap]) -> None:
        """Bring all lists to the device, where they are valid until `lists` holds others.

        copied: {name: TileMap} of the feature maps in `needed`, tiles of which are copied.
        """
        maps = {id(tile_map): tile_map for tile_map in self.maps.values()}
        rows = [row for m in maps.values() for row in all_tiles_buffers(*m.size).values()]
        rows += [((copied[name].source.size, 2), np.int32) for name in self.needed]
        values = [part for m in maps.values() for part in tile_arrays(m.size, m.count())]
        copies = {
            name: copy_list(copied[name].source, needed & ~copied[name].computed)
            for name, needed in self.needed.items()
        }
        arrays = iter(lists.send(rows, [*values, *copies.values()]))
        for key, m in maps.items():
            self._tiles[key] = Tiles(m.size, int(m.computed.sum()), next(arrays), next(arrays))
        for (name, from_to), array in zip(copies.items(), arrays, strict=True):
            self._copies[name] = array, len(from_to)

    def tiles(self, name: str) -> Tiles:
        """The tiles of a feature map to compute; of a plan that is on the device."""
        return self._tiles[id(self.maps[name])]

    def fill_copies(self, name: str, array: Array) -> None:
        """Copy representatives to the needed tiles that were not computed."""
        tiles_copy(self.dev, array, *self._copies[name])


class ForwardPlan(TilePlan):
    """The forward pass over an image of `size`, where x differs from the background in the tiles
    `active`.

    gradient_tiles: as gradient_tiles() returns it; None: all tiles. affected: the tiles of the
    image whose receptive field holds more than background. computed_fraction: share of the
    network's multiplications that is left.
    """

    def __init__(
        self,
        dev: Device,
        layers: list[Layer],
        size: tuple[int, int],
        active: np.ndarray,
        *,
        gradient_tiles: np.ndarray | None = None,
    ):
        radius, last = receptive_radius(layers), layers[-1].name
        computed = {name: pixels for name, pixels in radius.items() if name != "x"}  # x is given
        super().__init__(dev, layers, size, active, radius=computed)
        for layer in layers:
            of_layer = self.maps[layer.name].computed
            for name in layer.inputs:
                if name != "x":
                    needed = self.needed[name]
                    needed |= _read_forward(layer, of_layer, needed.shape)
        self.needed[last][:] = True
        self.affected = grow(active, _tiles_of(radius[last]))
        self.gradient_tiles = np.ones_like(active) if gradient_tiles is None else gradient_tiles
        count = {c.name: c.multiplications(*size) for c in convolutions(layers)}
        done = sum(n * self.maps[name].computed.mean() for name, n in count.items())
        self.computed_fraction = done / sum(count.values())

    def backward(self, arrays: dict[str, Array], lists: PackedArrays) -> BackwardPlan:
        """The backward pass, on the device; the outputs in `arrays` are completed where it reads
        them.
        """
        plan = BackwardPlan(self)
        plan.upload(lists, self.maps | plan.maps)
        for name in plan.needed.keys() - plan.maps.keys():
            plan.fill_copies(name, arrays[name])
        return plan


class BackwardPlan(TilePlan):
    """The backward pass after a forward pass. Among the needed tiles are those of forward outputs
    that it reads, as inputs of layers and as masks of ReLUs.
    """

    def __init__(self, forward: ForwardPlan):
        dev, layers, size = forward.dev, forward.layers, forward.size
        border = _tiles_of(max(LOSS_BORDER, receptive_radius(layers)[layers[-1].name]))
        active = forward.affected | forward.gradient_tiles
        super().__init__(dev, layers, size, active, radius=gradient_radius(layers), border=border)
        for layer in layers:
            out = self.maps[gradient_of(layer.name)].computed
            for name in layer.inputs:
                at_input = self.maps[gradient_of(name)].computed
                self.needed[gradient_of(layer.name)] |= _read_backward(layer, at_input, out.shape)
                if layer.reads_input_backward and name != "x":
                    reads = _read_forward(layer, out, at_input.shape) | at_input
                    self.needed[name] = self.needed.get(name, False) | reads
        self.needed[gradient_of("x")][:] = True
