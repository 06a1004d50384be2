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
    arrays: {name: array} of the outputs and of their gradients (buffers.gradient_of), without x;
    some share a buffer, one after the other.
    """

    def __init__(
        self,
        dev: Device,
        plan: WorkspacePlan,
        parameters: dict[str, Array],
        gradients: dict[str, Array],
        *,
        frozen: dict | None,
    ):
        self.dev, self.parameters, self.gradients = dev, parameters, gradients
        self._frozen = frozen
        self.size, self.plan = plan.size, plan
        self.arrays = {}
        table = plan.buffers()
        self._buffers = [dev.empty(*table[shared.label]) for shared in plan.shared]
        for shared, buffer in zip(plan.shared, self._buffers, strict=True):
            for name in shared.names:
                shape = plan.shapes[name]
                self.arrays[name] = buffer[: math.prod(shape)].reshape(shape)
        self.work = Work.empty(dev, *plan.work_floats)
        self.all_tiles = AllTiles(dev, plan.size, plan.layers)

    def follow(self, plan: WorkspacePlan) -> None:
        """Compute by another plan, of another policy, from now on."""
        if plan is not self.plan:
            self.plan = plan
            self.work.grow(self.dev, *plan.work_floats)

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
