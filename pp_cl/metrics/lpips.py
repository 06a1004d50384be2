"""LPIPS v0.1 with VGG16 (Zhang et al. 2018): a perceptual distance, run on the convolutions of the
renderer. The metric is here; the loss (training/perceptual.py) computes it with the same network.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import cycle
from types import ModuleType
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.device.launch import Program, group_ranges, lanes, row_parts
from pp_cl.errors import UserError
from pp_cl.layers.choice import AUTO, VARIANTS, ConvShape, blocking_of, choose, lay_out_forward
from pp_cl.layers.conv_direct import Direction, pack_weights
from pp_cl.layers.conv_winograd import TRANSFORMED
from pp_cl.layers.simple import maxpool2_backward, maxpool2_forward
from pp_cl.layers.tiles import VECTOR, Tiles, all_tiles, all_tiles_buffers
from pp_cl.metrics.lpips_weights import load_weights

# convolutions between the poolings of VGG16; the last one of each block is compared
BLOCKS = (2, 2, 3, 3, 3)
WIDTHS = (64, 128, 256, 512, 512)  # channels of the blocks
LEAST_SIZE = 16  # pixels: four poolings leave one
# in which convolutions are computed, and the source whose gradient is asked for
DIRECTIONS = ((Direction.FORWARD, None), (Direction.BACKWARD_INPUT, 0))

Size = tuple[int, int]  # (height, width)
Place = Callable[[str, tuple[int, ...]], Array]


@dataclass(frozen=True)
class VggConv:
    """A 3x3 convolution with ReLU of VGG16. name, source: of its output and of its input: "input",
    "conv0", "features0" (the last convolution of block 0), "pool1", ...
    """

    name: str
    source: str
    block: int
    ci: int
    co: int

    def weight_shape(self) -> tuple[int, ...]:
        """As conv.pack_weights makes it."""
        return -(-self.co // VECTOR), 3, 3, self.ci, VECTOR


def size_of(size: Size, block: int) -> Size:
    """(height, width) of a block's features for an image of `size`."""
    return size[0] >> block, size[1] >> block


def vgg_layers(widths: tuple[int, ...] = WIDTHS) -> list[VggConv]:
    """The convolutions in the order of the forward pass. widths: channels of the blocks."""
    layers: list[VggConv] = []
    ci, source = 3, "input"
    for block, (convolutions, co) in enumerate(zip(BLOCKS, widths, strict=True)):
        for i in range(convolutions):
            last = i == convolutions - 1
            name = f"features{block}" if last else f"conv{len(layers)}"
            layers.append(VggConv(name, source, block, ci, co))
            ci, source = co, name
        source = f"pool{block + 1}"
    return layers


def _variants(dev, variant, layer, size):
    """The modules that compute a convolution of an image of `size`: forward, and the gradient of
    its input.
    """
    pixels = math.prod(size_of(size, layer.block))
    return [
        VARIANTS[choose(dev, ConvShape(way, 3, (layer.ci,), layer.co, pixels, source), variant)]
        for way, source in DIRECTIONS
    ]


def _scratch_floats(dev, variant, layer, size):
    """What _variants() need, as conv_direct.scratch_floats says it, [forward, backward]."""
    height, _ = size_of(size, layer.block)
    return [
        module.scratch_floats(
            dev, blocking_of(dev), direction, height, layer.weight_shape(), layer.ci
        )
        for module, (direction, _) in zip(
            _variants(dev, variant, layer, size), DIRECTIONS, strict=True
        )
    ]


def lpips_program(dev: Device) -> Program:
    """The Program of cl/metrics/lpips.cl in the device's form."""
    members = row_parts(dev)
    items = group_ranges(dev, 1, members)[1] or 1
    return dev.program("metrics/lpips", LANES=lanes(dev), GROUP=members, ITEMS=items)


class Lpips:
    """The network, prepared for images of one size at a time, and the distance of image pairs.

    weights: as load_weights() returns them, which is the default (and may raise UserError).
    variant: of the convolutions, as choose() takes it.
    """

    def __init__(
        self,
        dev: Device,
        weights: dict[str, np.ndarray] | None = None,
        variant: str = AUTO,
    ):
        weights = load_weights() if weights is None else weights
        self.dev = dev
        self.variant, self.blocking = variant, blocking_of(dev)
        self.program = lpips_program(dev)
        self.heads = [dev.upload(weights[f"head{i}"]) for i in range(len(BLOCKS))]
        self.widths = tuple(head.size for head in self.heads)
        self._weights, self._biases = {}, {}
        for i, layer in enumerate(vgg_layers(self.widths)):
            self._weights[layer.name] = dev.upload(pack_weights(weights[f"kernel{i}"]))
            self._biases[layer.name] = dev.upload(weights[f"bias{i}"])
        self._size = None
        self._choices: dict[str, list[ModuleType]] = {}
        self._laid_out: dict[str, Array | None] = {}
        self._tiles: list[Tiles] = []  # of each block

    @staticmethod
    def table(
        dev: Device, size: Size, widths: tuple[int, ...] = WIDTHS, variant: str = AUTO
    ) -> Table:
        """The device buffers of a network that is trained with, for images of `size`: weights, work
        and tiles, without feature maps.
        """
        floats: dict[str, int] = {}
        for layer in vgg_layers(widths):
            forward, backward = _scratch_floats(dev, variant, layer, size)
            for name, needed in (*forward.items(), *backward.items()):
                floats[name] = max(needed, floats.get(name, 0))
            floats[f"weights of {layer.name}"] = math.prod(layer.weight_shape())
            floats[f"bias of {layer.name}"] = layer.co
            floats[f"transformed weights of {layer.name}"] = forward.get(TRANSFORMED, 0)
        table: Table = {name: ((number,), np.float32) for name, number in floats.items()}
        for block, width in enumerate(widths):
            table[f"head {block}"] = (width,), np.float32
            tiles = all_tiles_buffers(*size_of(size, block))
            table |= {f"tiles of block {block}, {name}": row for name, row in tiles.items()}
        return table

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
        # Both images go through a block before either goes on, so that the features of one block
        # only are held.
        features = [
            self.features(self.dev.upload(image, np.float32), (height, width), self._place(name))
            for name, image in (("a", a), ("b", b))
        ]
        total, place = 0.0, self._place("distance")
        for block, (one, other) in enumerate(zip(*features, strict=True)):
            distance = place("features", size_of((height, width), block))
            self.compare(block, one, other, distance)
            total += float(distance.get().mean(dtype=np.float64))
        return total

    def _place(self, image):
        """Where features() puts an image's maps: the features in memory of their own, the others by
        turns in two places, which all images share: nothing is read there once a block is done. New
        memory for each map took a quarter of the time.
        """
        turns = cycle(range(2))

        def place(name, shape):
            held = image if name.startswith("features") else next(turns)
            n = math.prod(shape)
            return self.dev.scratch(("lpips", held), n)[:n].reshape(shape)

        return place

    def features(self, image: Array, size: Size, place: Place, corner: int = 0) -> Iterator[Array]:
        """Computes and yields each block's features (H, W, C), block by block.

        image: (IH, IW, 3) float32, of which the rectangle of `size` from its value `corner` on is
        looked at; at least LEAST_SIZE pixels a side. place(name, shape) returns the array in which
        to compute a map, see VggConv; its input must not be in the same one.
        """
        self._prepare(size)
        height, width = size
        x = place("input", (height, width, 3))
        self._launch_input("lpips_input", size, corner, image=image, x=x)
        layers = iter(vgg_layers(self.widths))
        for block, convolutions in enumerate(BLOCKS):
            if block:
                pooled = place(f"pool{block}", (*size_of(size, block), x.shape[2]))
                maxpool2_forward(self.dev, x, pooled)
                x = pooled
            for _ in range(convolutions):
                layer = next(layers)
                out = place(layer.name, (*x.shape[:2], layer.co))
                self._convolve(layer, x, out)
                x = out
            yield x

    def compare(self, block: int, a: Array, b: Array, distance: Array) -> None:
        """distance (H, W) of the features a and b (H, W, C) of a block; LPIPS is the sum of its
        means.
        """
        self._launch_pixels("lpips_distance", block, a=a, b=b, distance=distance.reshape(-1))

    def backward(
        self,
        maps: dict[str, Array],
        targets: list[Array],
        weight: float,
        *,
        place: Place,
        grad_image: Array,
        corner: int = 0,
    ) -> None:
        """Adds the gradient of weight * LPIPS by the image to grad_image.

        maps: {name: (H, W, C)} of the convolutions' outputs for that image, from the last call of
        features(). targets: the features that it is compared with, of each block. place, corner: as
        features() takes them; a gradient of the name "gradient" is computed from the one before.
        """
        grad: Any = None
        layers = vgg_layers(self.widths)[::-1]
        for block in reversed(range(len(BLOCKS))):
            x = maps[f"features{block}"]
            pooled_grad, grad = grad, place("gradient", x.shape)
            share = weight / math.prod(x.shape[:2])
            self._launch_pixels(
                "lpips_distance_backward",
                block,
                weight=share,
                a=x,
                b=targets[block],
                grad_a=grad.reshape(-1, x.shape[2]),
            )
            if pooled_grad is not None:
                maxpool2_backward(self.dev, x, pooled_grad, grad)
            for layer in (layer for layer in layers if layer.block == block):
                grad_x = place("gradient", (*x.shape[:2], layer.ci))
                # Poolings and the input are no ReLU's outputs.
                self._convolve_backward(layer, grad, grad_x, maps.get(layer.source))
                grad = grad_x
        self._launch_input(
            "lpips_input_backward", grad.shape[:2], corner, grad_x=grad, grad_image=grad_image
        )

    # ----------------------------------------------------------------------------------------------

    def _prepare(self, size):
        """Variants, transformed weights and tiles for images of this size."""
        if size == self._size:
            return
        self._size, self._laid_out, self._tiles = None, {}, []
        for layer in vgg_layers(self.widths):
            forward, _ = self._choices[layer.name] = _variants(self.dev, self.variant, layer, size)
            self._laid_out[layer.name] = lay_out_forward(
                self.dev, forward, self._weights[layer.name]
            )
        self._tiles = [all_tiles(self.dev, *size_of(size, i)) for i in range(len(BLOCKS))]
        self._size = size

    def _convolve(self, layer, x, out):
        forward, _ = self._choices[layer.name]
        forward.forward(
            self.dev,
            self.blocking,
            (x,),
            self._weights[layer.name],
            self._biases[layer.name],
            out,
            relu=True,
            tiles=self._tiles[layer.block],
            laid_out=self._laid_out[layer.name],
        )

    def _convolve_backward(self, layer, grad_out, grad_x, mask):
        _, backward = self._choices[layer.name]
        backward.backward_input(
            self.dev,
            self.blocking,
            self._weights[layer.name],
            0,
            grad_out,
            grad_x,
            mask=mask,
            tiles=self._tiles[layer.block],
        )

    def _launch_input(self, kernel, size, corner, **arrays):
        height, width = size
        image = arrays["image"] if "image" in arrays else arrays["grad_image"]
        self.program.launch(
            kernel,
            (width, height),
            h=height,
            w=width,
            image_width=image.shape[1],
            corner=corner,
            **arrays,
        )

    def _launch_pixels(self, kernel, block, a, b, **arguments):
        channels = a.shape[2]
        n = a.size // channels
        self.program.launch(
            kernel,
            *group_ranges(self.dev, n, row_parts(self.dev)),
            n=n,
            c=channels,
            a=a.reshape(n, channels),
            b=b.reshape(n, channels),
            head=self.heads[block],
            **arguments,
        )
