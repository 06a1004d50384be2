"""LPIPS v0.1 with VGG16 (Zhang et al. 2018), run on the convolutions of the renderer."""

import math
from collections.abc import Iterator
from itertools import cycle
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.device import Device, Program
from pp_cl.engine.device.launch import group_ranges, lanes, row_parts
from pp_cl.engine.layers.choice import VARIANTS, prepared
from pp_cl.engine.layers.conv import Conv, ConvShape, pack_weights
from pp_cl.engine.layers.simple import maxpool2_forward
from pp_cl.engine.layers.tiles import all_tiles
from pp_cl.errors import UserError
from pp_cl.metrics.lpips_weights import load_weights

# convolutions between the poolings of VGG16; the last one of each block is compared
BLOCKS = (2, 2, 3, 3, 3)
LEAST_SIZE = 16  # pixels: four poolings leave one


def lpips_program(dev: Device) -> Program:
    """The Program of cl/metrics/lpips.cl in the device's form."""
    members = row_parts(dev)
    items = group_ranges(dev, 1, members)[1] or 1
    return dev.program("metrics/lpips", LANES=lanes(dev), GROUP=members, ITEMS=items)


class Lpips:
    """The network, prepared for one image size at a time. weights: as from load_weights()."""

    def __init__(self, dev: Device, weights: dict[str, np.ndarray] | None = None):
        weights = load_weights() if weights is None else weights
        self.dev, self.program = dev, lpips_program(dev)
        self._heads = [dev.upload(weights[f"head{i}"]) for i in range(len(BLOCKS))]
        # for each block, [(channels in, out, weights, biases)]
        self._layers: list[list[tuple]] = [[] for _ in BLOCKS]
        for i, block in enumerate(np.repeat(range(len(BLOCKS)), BLOCKS)):
            kernel, bias = weights[f"kernel{i}"], dev.upload(weights[f"bias{i}"])
            co, ci = kernel.shape[:2]
            self._layers[block].append((ci, co, dev.upload(pack_weights(kernel)), bias))
        self._size: tuple[int, int] | None = None
        # for each block, its convolutions and its tiles
        self._blocks: list[tuple[list[Conv], Any]] = []

    def distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """LPIPS of two (H, W, 3) images in [0, 1]. Raises UserError if a side has less than
        LEAST_SIZE pixels, ValueError for different shapes.
        """
        if a.shape != b.shape:
            raise ValueError(f"a {a.shape}, b {b.shape}")
        height, width = a.shape[:2]
        if min(height, width) < LEAST_SIZE:
            raise UserError(
                f"{width}x{height} pixels, but LPIPS needs {LEAST_SIZE}x{LEAST_SIZE}: "
                "take larger images or leave lpips out of --metrics"
            )
        self._prepare(height, width)
        # Both images pass a block before either enters the next, so that memory holds the features
        # of a single block.
        features = [
            self._features(self.dev.upload(image, np.float32), name)
            for name, image in (("a", a), ("b", b))
        ]
        total = 0.0
        for block, (a_features, b_features) in enumerate(zip(*features, strict=True)):
            total += float(
                self._compare(block, a_features, b_features).get().mean(dtype=np.float64)
            )
        return total

    def _features(self, image: Array, name: str) -> Iterator[Array]:
        """Compute and yield the features (H, W, C) of an image, block by block."""
        turns = cycle((0, 1))
        h, w, _ = image.shape
        x = self._place(next(turns), image.shape)
        self.program.launch("lpips_input", h * w, n=h * w, image=image, x=x)
        for block, (convolutions, tiles) in enumerate(self._blocks):
            if block:
                height, width, channels = x.shape
                pooled = self._place(next(turns), (height // 2, width // 2, channels))
                maxpool2_forward(self.dev, x, pooled)
                x = pooled
            for i, conv in enumerate(convolutions, 1):
                place = name if i == len(convolutions) else next(turns)
                out = self._place(place, (*x.shape[:2], conv.shape.co))
                VARIANTS[conv.variant].forward(conv, (x,), out, relu=True, tiles=tiles)
                x = out
            yield x

    def _place(self, name, shape):
        """Memory for a map. Each image's features have their own; the other maps alternate between
        two buffers, which nobody reads after a block. Allocating anew took a quarter of the time.
        """
        n = math.prod(shape)
        return self.dev.scratch(("lpips", name), n)[:n].reshape(shape)

    def _compare(self, block, a, b):
        """(H, W) distances between a block's features a and b (H, W, C)."""
        height, width, channels = a.shape
        n, distance = height * width, self._place("distance", (height, width))
        self.program.launch(
            "lpips_distance",
            *group_ranges(self.dev, n, row_parts(self.dev)),
            n=n,
            c=channels,
            a=a.reshape(n, channels),
            b=b.reshape(n, channels),
            head=self._heads[block],
            distance=distance.reshape(-1),
        )
        return distance

    def _prepare(self, height, width):
        """Choose variants, lay out their weights and make tiles for images of this size."""
        if (height, width) == self._size:
            return
        self._size, self._blocks = None, []
        for block, layers in enumerate(self._layers):
            size, convolutions = (height >> block, width >> block), []
            for ci, co, weights, bias in layers:
                shape = ConvShape("forward", 3, (ci,), co, size)
                convolutions.append(prepared(self.dev, shape, weights, bias))
            self._blocks.append((convolutions, all_tiles(self.dev, *size)))
        self._size = height, width
