"""LPIPS v0.1 with VGG16 (Zhang et al. 2018): a perceptual distance, run on the convolutions of the
renderer.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device, Program
from pp_cl.device.launch import group_ranges, lanes, row_parts
from pp_cl.errors import UserError
from pp_cl.layers.choice import blocking_of, choose
from pp_cl.layers.conv_direct import ConvShape, Direction, pack_weights
from pp_cl.layers.simple import maxpool2_forward
from pp_cl.layers.tiles import all_tiles
from pp_cl.metrics.lpips_weights import load_weights

# convolutions between the poolings of VGG16; the last one of each block is compared
BLOCKS = (2, 2, 3, 3, 3)
LEAST_SIZE = 16  # pixels: four poolings leave one

Size = tuple[int, int]  # (height, width)


@dataclass(frozen=True)
class VggConv:
    """A 3x3 convolution with ReLU of VGG16. name: of its output."""

    name: str
    block: int
    ci: int
    co: int


def size_of(size: Size, block: int) -> Size:
    """(height, width) of a block's features for an image of `size`."""
    return size[0] >> block, size[1] >> block


def vgg_layers(widths: tuple[int, ...]) -> list[VggConv]:
    """The convolutions in the order of the forward pass. widths: channels of the blocks."""
    layers: list[VggConv] = []
    ci = 3
    for block, (convolutions, co) in enumerate(zip(BLOCKS, widths, strict=True)):
        for _ in range(convolutions):
            layers.append(VggConv(f"conv{len(layers)}", block, ci, co))
            ci = co
    return layers


def lpips_program(dev: Device) -> Program:
    """The Program of cl/metrics/lpips.cl in the device's form."""
    members = row_parts(dev)
    items = group_ranges(dev, 1, members)[1] or 1
    return dev.program("metrics/lpips", LANES=lanes(dev), GROUP=members, ITEMS=items)


class Lpips:
    """The network, prepared for images of one size at a time, and the distance of image pairs.

    weights: as load_weights() returns them, which is the default (and may raise UserError).
    """

    def __init__(self, dev: Device, weights: dict[str, np.ndarray] | None = None):
        weights = load_weights() if weights is None else weights
        self.dev = dev
        self.blocking = blocking_of(dev)
        self.program = lpips_program(dev)
        self.heads = [dev.upload(weights[f"head{i}"]) for i in range(len(BLOCKS))]
        self.layers = vgg_layers(tuple(head.size for head in self.heads))
        self._weights, self._biases = {}, {}
        for i, layer in enumerate(self.layers):
            self._weights[layer.name] = dev.upload(pack_weights(weights[f"kernel{i}"]))
            self._biases[layer.name] = dev.upload(weights[f"bias{i}"])
        self._size = None
        # {layer: (convolution, weights as it reads them, tiles)}
        self._prepared: dict[str, tuple] = {}

    def distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """LPIPS of two (H, W, 3) images in [0, 1].

        Raises UserError for images of less than LEAST_SIZE pixels a side, ValueError for different
        shapes.
        """
        if a.shape != b.shape:
            raise ValueError(f"a {a.shape}, b {b.shape}")
        height, width = a.shape[:2]
        if min(height, width) < LEAST_SIZE:
            raise UserError(
                f"{width}x{height} pixels, LPIPS needs {LEAST_SIZE}x{LEAST_SIZE}: "
                "take larger images or leave lpips out of --metrics"
            )
        self._prepare((height, width))
        # Both images go through a block before either goes on, so that the features of one block
        # only are held.
        features = [
            self._features(self.dev.upload(image, np.float32), name)
            for name, image in (("a", a), ("b", b))
        ]
        total = 0.0
        for block, (one, other) in enumerate(zip(*features, strict=True)):
            total += float(self._compare(block, one, other).get().mean(dtype=np.float64))
        return total

    def _features(self, image: Array, name: str) -> Iterator[Array]:
        """Computes and yields each block's features (H, W, C) of an image, block by block."""
        turns = cycle((0, 1))
        h, w, _ = image.shape
        x = self._place(next(turns), image.shape)
        self.program.launch("lpips_input", h * w, n=h * w, image=image, x=x)
        for block, convolutions in enumerate(BLOCKS):
            if block:
                pooled = self._place(next(turns), (*size_of(x.shape[:2], 1), x.shape[2]))
                maxpool2_forward(self.dev, x, pooled)
                x = pooled
            layers = [layer for layer in self.layers if layer.block == block]
            for i, layer in enumerate(layers):
                place = name if i == convolutions - 1 else next(turns)
                out = self._place(place, (*x.shape[:2], layer.co))
                self._convolve(layer, x, out)
                x = out
            yield x

    def _place(self, name, shape):
        """Memory for a map: an image's features have one of their own, the other maps take turns in
        two, which all images share: nothing is read there once a block is done. New memory for each
        map took a quarter of the time.
        """
        n = math.prod(shape)
        return self.dev.scratch(("lpips", name), n)[:n].reshape(shape)

    def _compare(self, block, a, b):
        """(H, W) distances of the features a and b (H, W, C) of a block; LPIPS is the sum of their
        means.
        """
        height, width, channels = a.shape
        n, distance = height * width, self._place("distance", (height, width))
        self.program.launch(
            "lpips_distance",
            *group_ranges(self.dev, n, row_parts(self.dev)),
            n=n,
            c=channels,
            a=a.reshape(n, channels),
            b=b.reshape(n, channels),
            head=self.heads[block],
            distance=distance.reshape(-1),
        )
        return distance

    def _prepare(self, size):
        """Variants, weights as they read them, and tiles for images of this size."""
        if size == self._size:
            return
        self._size, self._prepared = None, {}
        tiles = [all_tiles(self.dev, *size_of(size, block)) for block in range(len(BLOCKS))]
        for layer in self.layers:
            of_block = size_of(size, layer.block)
            shape = ConvShape(Direction.FORWARD, 3, (layer.ci,), layer.co, of_block)
            conv = choose(self.dev, shape)(self.dev, self.blocking, shape)
            weights = conv.laid_out(self._weights[layer.name])
            self._prepared[layer.name] = conv, weights, tiles[layer.block]
        self._size = size

    def _convolve(self, layer, x, out):
        conv, weights, tiles = self._prepared[layer.name]
        conv.forward((x,), weights, self._biases[layer.name], out, relu=True, tiles=tiles)
