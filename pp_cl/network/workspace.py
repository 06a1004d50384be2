"""The device buffers in which a network computes images of one size."""

import math

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.layers.direction import Direction
from pp_cl.layers.policy import ConvolutionPolicy
from pp_cl.layers.tiles import LANES, all_tiles_buffers
from pp_cl.layers.variants import Convolution
from pp_cl.layers.work import COUNTERS, Work
from pp_cl.network.architectures import convolutions
from pp_cl.network.buffers import SharedBuffer, gradient_of, lifetimes, plan_buffers
from pp_cl.network.layer import Conv, Layer
from pp_cl.network.sparse_tiles import AllTiles, levels_of

# The convolutions' Work in a table of buffers.
SCRATCH, WEIGHTS = "convolutions: scratch", "convolutions: transformed weights"


def parameter_table(layers: list[Layer]) -> Table:
    """{name: (shape, dtype)} of the parameters: "enc0.a.weight" (ceil(CO/16), K, K, CI, 16),
    "enc0.a.bias" (ceil(CO/16) * 16,), ...
    """
    table = {}
    for layer in convolutions(layers):
        co, ci, k, _ = layer.weight_shape()
        blocks = -(-co // LANES)
        table[layer.name + ".weight"] = (blocks, k, k, ci, LANES), np.float32
        table[layer.name + ".bias"] = (blocks * LANES,), np.float32
    return table


class WorkspacePlan:
    """What a network of these layers needs for images of `size` = (height, width), forward alone or
    with the backward pass (training).

    convolutions: {(layer, direction, source): Convolution}, the variants that the policy chose.
    shapes: {name: shape} of the outputs and of their gradients, that of x and its own among them.
    Raises UserError where no variant is as exact as the policy's tolerance.
    """

    def __init__(
        self,
        dev: Device,
        layers: list[Layer],
        size: tuple[int, int],
        training: bool,
        *,
        policy: ConvolutionPolicy,
    ):
        self.layers, self.size = layers, size
        height, width = size
        shapes = {n: (height >> level, width >> level) for n, level in levels_of(layers).items()}
        channels = {"x": sum(layers[0].sources)} | {x.name: x.channels for x in layers}
        outputs = {name: (*shape, channels[name]) for name, shape in shapes.items()}
        self.shapes = outputs | {gradient_of(name): shape for name, shape in outputs.items()}
        self.shared: list[SharedBuffer] = plan_buffers(lifetimes(layers, training), self.shapes)
        self.convolutions: dict[tuple, Convolution] = {}
        self.work_floats = [COUNTERS, 1]
        parameters = parameter_table(layers)
        for layer in convolutions(layers):
            rows, columns = shapes[layer.name]
            for direction, source in layer.computations(training):
                shape = layer.conv_shape(direction, rows * columns, source)
                convolution = policy.convolution(dev, shape)
                self.convolutions[layer.name, direction, source] = convolution
                weight_shape, _ = parameters[layer.name + ".weight"]
                needs = convolution.work_floats(direction, rows, weight_shape, shape.ci)
                self.work_floats = [max(*n) for n in zip(self.work_floats, needs, strict=True)]

    def buffers(self) -> Table:
        """{name: (shape, dtype)} of all device buffers of a Workspace."""
        table = {buffer.label: ((buffer.floats,), np.float32) for buffer in self.shared}
        for name, floats in zip((SCRATCH, WEIGHTS), self.work_floats, strict=True):
            table[name] = (floats,), np.float32
        for level in sorted(set(levels_of(self.layers).values())):
            tiles = all_tiles_buffers(self.size[0] >> level, self.size[1] >> level)
            table |= {f"tiles of level {level}, {name}": row for name, row in tiles.items()}
        return table


class Workspace:
    """The buffers of a plan, and everything else that layers compute with (layer.Resources).

    parameters, gradients: of the network. frozen: None, or {(layer, variant): weights} that fills
    with the weights as forward() of a variant transforms them, because they no longer change.
    plan: the one that is followed. arrays: {name: array} of the outputs and of their gradients
    (buffers.gradient_of), without x; some share a buffer, one after the other.
    """

    def __init__(
        self,
        dev: Device,
        parameters: dict[str, Array],
        gradients: dict[str, Array],
        *,
        frozen: dict | None,
    ):
        self.dev, self.parameters, self.gradients = dev, parameters, gradients
        self._frozen = frozen
        self.plan: WorkspacePlan | None = None
        self.arrays: dict[str, Array] = {}
        self._buffers: list[Array | None] = []
        self._arrays_of = {}  # {plan: arrays} in the present buffers
        self._all_tiles = None
        self.work = Work.empty(dev, COUNTERS, 1)

    def follow(self, plan: WorkspacePlan) -> None:
        """Compute by a plan from now on, in the same buffers where they are large enough: images of
        a film differ in size. The arrays are undefined.
        """
        if plan is self.plan:
            return
        if self.plan is None or plan.size != self.plan.size:
            self._all_tiles = None
        self.plan = plan
        self.work.grow(self.dev, *plan.work_floats)
        self._reserve([shared.floats for shared in plan.shared])
        if plan not in self._arrays_of:
            self._arrays_of[plan] = {
                name: buffer[: math.prod(plan.shapes[name])].reshape(plan.shapes[name])
                for shared, buffer in zip(plan.shared, self._buffers, strict=False)
                for name in shared.names
            }
        self.arrays = self._arrays_of[plan]

    def _reserve(self, floats):
        """Make room for so many floats in each buffer, where there is less."""
        self._buffers += [None] * (len(floats) - len(self._buffers))
        held = [0 if buffer is None else buffer.size for buffer in self._buffers]
        small = [i for i, needed in enumerate(floats) if held[i] < needed]
        if small:
            self.arrays = {}
            self._arrays_of.clear()
        for i in small:  # the old ones are freed first
            self._buffers[i] = None
        for i in small:
            self._buffers[i] = self.dev.empty((floats[i],))

    @property
    def all_tiles(self) -> AllTiles:
        """Of an image of the plan's size."""
        if self._all_tiles is None:
            self._all_tiles = AllTiles(self.dev, self.plan.size, self.plan.layers)
        return self._all_tiles

    def convolution(
        self, layer: Conv, direction: Direction, source: int | None = None
    ) -> Convolution:
        """As layer.Resources."""
        return self.plan.convolutions[layer.name, direction, source]

    def laid_out(self, layer: Conv) -> Array | None:
        """As layer.Resources."""
        if self._frozen is None:
            return None
        convolution = self.convolution(layer, Direction.FORWARD)
        if (layer.name, convolution) not in self._frozen:
            weight = self.parameters[layer.name + ".weight"]
            self._frozen[layer.name, convolution] = convolution.lay_out(weight)
        return self._frozen[layer.name, convolution]
