"""Which tiles of the network's feature maps need computing, where much of the image is background.

Where the network sees nothing but background, its output depends on nothing but the distance from
the borders of the image, which it sees as zeros. So the tiles that see only background fall into
classes of equal ones: one class inside, one for each place where a border is felt. One tile of each
class is computed, its representative; the others are copies of it, made where something reads them.
In the sums over the image, the gradients of weights, a representative counts as often as its class
has tiles. The results are the same but for rounding: Winograd's transforms mix the last bits of a
tile.

The backward pass has classes of its own: of the tiles where the network saw only background, those
whose gradient of the image has the bits of their representative's. How far something reaches,
forward or backward, is counted in pixels of the image at every level.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pp_cl.layers.tiles import SIDE, grid_shape, some_tiles, tiles_compare, tiles_copy

# Tiles of the image's gradient so near its border are classes of their own: losses see the border
# from afar, too.
LOSS_BORDER = 48


@dataclass(frozen=True)
class Layout:
    """The tiles of one feature map, whose height and width are those of the image divided by
    2**level.

    source: (rows, columns) int, the computed tile that has the same values: itself, or its class's
    representative.
    """

    level: int
    source: np.ndarray

    @cached_property
    def computed(self):
        """(rows, columns) bool."""
        return self.source == np.arange(self.source.size).reshape(self.source.shape)

    def count(self):
        """(rows, columns) of tiles that each tile stands for, itself among them; 0 for copies."""
        return np.bincount(self.source.ravel(), minlength=self.source.size).reshape(
            self.source.shape
        )


def layout(size, level, active, border):
    """Layout of a feature map in an image of `size` = (height, width), in which the `active` tiles
    are in no class.

    active: (rows, columns) bool. border: the border of the image is felt so many tiles of level 0
    away.
    """
    rows, columns = (_classes(length, level, border * SIDE) for length in size)
    classes = (rows[:, None] * (columns.max() + 1) + columns).ravel()
    idle, source = np.flatnonzero(~active), np.arange(active.size)
    representative = np.zeros(classes.max() + 1, int)
    # the last one written stays: the first of its class
    representative[classes[idle[::-1]]] = idle[::-1]
    source[idle] = representative[classes[idle]]
    return Layout(level, source.reshape(active.shape))


def _classes(length, level, border):
    """Classes of the tiles along one axis of the image: those that a border is felt in have their
    own.
    """
    side = SIDE << level
    start = np.arange(0, length, side)
    felt = (start < border) | (start + side > length - border)
    return np.where(felt, np.arange(len(start)), len(start))


def forward_reach(steps):
    """{name: pixels}: how far from its place in x a change is felt in the output of a step."""
    reach = {"x": 0}
    for step in steps:
        own = {"conv3": 2, "conv1": 0, "pool": 1, "up": 2}[step.kind] << step.level >> 1
        reach[step.name] = max(reach[name] for name in step.inputs) + own
    return reach


def backward_reach(steps):
    """{name: pixels}: how far from its place in the image's gradient a change is felt in the
    gradient of a step's output.
    """
    reach = dict.fromkeys([*(step.name for step in steps), "x"], 0)
    for step in reversed(steps):
        own = {"conv3": 1, "conv1": 0, "pool": 0, "up": 2}[step.kind] << step.level
        for name in step.inputs:
            reach[name] = max(reach[name], reach[step.name] + own)
    return reach


def grow(tiles, n=1):
    """(rows, columns) bool: the tiles within n tiles, diagonals included, of those that are set."""
    for _ in range(2):  # along the columns, then along the rows
        length = len(tiles)
        total = np.zeros((length + 1, tiles.shape[1]), np.int32)
        np.cumsum(tiles, 0, out=total[1:])
        place = np.arange(length)
        tiles = (total[np.minimum(place + n + 1, length)] > total[np.maximum(place - n, 0)]).T
    return tiles


def halve(tiles, levels=1):
    """The tiles 2**levels as wide that hold any of those that are set."""
    for _ in range(levels):
        rows, columns = tiles.shape
        padded = np.pad(tiles, ((0, rows % 2), (0, columns % 2)))
        tiles = padded.reshape(-1, 2, padded.shape[1] // 2, 2).any((1, 3))
    return tiles


def double(tiles, shape):
    """The tiles half as wide that lie in those that are set; there are (rows, columns) = shape of
    them.
    """
    return tiles.repeat(2, 0).repeat(2, 1)[: shape[0], : shape[1]]


class Everything:
    """A pass in which all tiles are computed. levels: {name: level} of the feature maps."""

    def __init__(self, dev, size, levels):
        self.levels = levels
        self._tiles = {}
        for level in sorted(set(levels.values())):
            height, width = size[0] >> level, size[1] >> level
            self._tiles[level] = some_tiles(
                dev, (height, width), np.ones(grid_shape(height, width))
            )

    def tiles(self, name):
        """tiles.Tiles of the feature map that a step computes."""
        return self._tiles[self.levels[name]]

    def complete(self, name, array):
        """Called once all computed tiles of a feature map are there."""


class Active:
    """A pass in which only some tiles of each feature map are computed.

    found: (rows, columns) bool, the tiles of the image where it starts. levels, reach: {name:
    level, pixels} of the feature maps: how far from `found`, and with `border` tiles more from the
    image's border, they are to be computed. Of each feature map: layouts, {name: Layout}, and read,
    {name: (rows, columns) bool}, the tiles that something reads.
    """

    def __init__(self, dev, size, found, levels, reach, border=0):
        self.dev = dev
        self.size = size
        made = {}
        self.layouts = {}
        for name, level in levels.items():
            n = -(-reach[name] // SIDE)
            if (level, n) not in made:
                made[level, n] = layout(size, level, halve(grow(found, n), level), border + n)
            self.layouts[name] = made[level, n]
        self.read = {name: np.zeros_like(of.computed) for name, of in self.layouts.items()}
        self._tiles = {}

    def tiles(self, name):
        """tiles.Tiles of the feature map that a step computes."""
        of = self.layouts[name]
        if id(of) not in self._tiles:
            size = self.size[0] >> of.level, self.size[1] >> of.level
            self._tiles[id(of)] = some_tiles(self.dev, size, of.count())
        return self._tiles[id(of)]

    def complete(self, name, array, read=None):
        """Copy to the tiles that something reads and nobody computes. Called once the computed ones
        are there.

        read: others than self.read[name].
        """
        of = self.layouts[name]
        tiles_copy(
            self.dev, array, of.source, (self.read[name] if read is None else read) & ~of.computed
        )


class ActiveForward(Active):
    """The forward pass over an image of `size`, where x differs from the background in the tiles
    `found`.
    """

    def __init__(self, dev, steps, size, found):
        reach, last = forward_reach(steps), steps[-1].name
        super().__init__(dev, size, found, {step.name: step.level for step in steps}, reach)
        for step in steps:
            for name in step.inputs:
                if name != "x":
                    self.read[name] |= _reads_forward(
                        step, self.layouts[step.name].computed, self.read[name].shape
                    )
        self.read[last][:] = True
        self.felt = grow(found, -(-reach[last] // SIDE))


class ActiveBackward(Active):
    """The backward pass after `forward`, given the gradient (H, W, C) of the last step's output."""

    def __init__(self, dev, steps, forward, grad_out):
        border = -(-max(LOSS_BORDER, forward_reach(steps)[steps[-1].name]) // SIDE)
        classes = layout(forward.size, 0, forward.felt, border)
        found = forward.felt | tiles_compare(dev, grad_out, classes.source)
        levels = {step.name: step.level for step in steps} | {"x": 0}
        super().__init__(dev, forward.size, found, levels, backward_reach(steps), border)
        # {name: (rows, columns) bool} of their tiles that are read, as inputs and as masks of a
        # ReLU
        self.activations = {}
        for step in steps:
            out = self.layouts[step.name].computed
            for name in step.inputs:
                at_input = self.layouts[name].computed
                self.read[step.name] |= _reads_backward(step, at_input, out.shape)
                if step.kind != "up" and name != "x":
                    reads = _reads_forward(step, out, at_input.shape) | at_input
                    self.activations[name] = self.activations.get(name, False) | reads
        self.read["x"][:] = True


def _reads_forward(step, computed, shape):
    """Tiles of a step's input, (rows, columns) = shape of them, that the computed tiles of its
    output are made of.
    """
    if step.kind == "conv3":
        return grow(computed)
    if step.kind == "pool":
        return double(computed, shape)
    return halve(grow(computed)) if step.kind == "up" else computed


def _reads_backward(step, computed, shape):
    """Tiles of the gradient of a step's output that the computed tiles of its input's gradient are
    made of.
    """
    if step.kind == "conv3":
        return grow(computed)
    if step.kind == "pool":
        return halve(computed)
    return grow(double(computed, shape)) if step.kind == "up" else computed
