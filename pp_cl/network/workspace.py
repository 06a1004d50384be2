"""The device buffers in which a network computes images of one size: which arrays share a buffer,
one after the other (assignment by liveness), and memory for the convolutions to work in.
"""

import math
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.layers.choice import ConvolutionPolicy, ConvShape
from pp_cl.layers.conv import COUNTERS, Work
from pp_cl.layers.tiles import all_tiles_buffers
from pp_cl.network.layers import (
    Layer,
    computations,
    convolutions,
    gradient_of,
    levels_of,
    parameter_table,
)
from pp_cl.network.tile_plan import AllTiles, reads_input_backward

# The convolutions' Work in a table of buffers.
SCRATCH, WEIGHTS = "convolutions: scratch", "convolutions: transformed weights"


def lifetimes(layers: list[Layer], training: bool) -> list[tuple[str, int, int]]:
    """[(name, first, last)] of a network's arrays, in layers of its forward and backward pass, by
    first use.

    The network's input "x" is not among them: it belongs to the caller.
    """
    schedule = [(*layer.inputs, layer.name) for layer in layers]
    if training:
        for layer in reversed(layers):
            read = layer.inputs if reads_input_backward(layer) else ()
            written = [gradient_of(name) for name in layer.inputs]
            schedule.append((*read, gradient_of(layer.name), *written))
    found = {}
    for time, names in enumerate(schedule):
        for name in names:
            found[name] = (found.get(name, (time,))[0], time)
    del found["x"]
    last = layers[-1].name
    found[last] = (found[last][0], len(schedule))  # the caller may read it after backward
    return [(name, *lifetime) for name, lifetime in found.items()]


@dataclass
class SharedBuffer:
    """A buffer that holds several arrays, one after the other."""

    floats: int
    names: list[str]
    free_from: int

    def add(self, name: str, floats: int, last: int) -> None:
        """Give the buffer an array that lives until step `last`."""
        self.floats = max(self.floats, floats)
        self.names.append(name)
        self.free_from = last + 1

    @property
    def label(self) -> str:
        """Its name in the memory plan."""
        return " = ".join(self.names)


def plan_buffers(
    lifetimes: list[tuple[str, int, int]], shapes: dict[str, tuple]
) -> list[SharedBuffer]:
    """Buffers in which no two arrays live at the same time.

    lifetimes: [(name, first, last)] by first use. An array takes the free buffer that fits it best;
    if none is large enough, the largest free one grows.
    """
    buffers = []
    for name, first, last in lifetimes:
        floats = math.prod(shapes[name])
        free = [b for b in buffers if b.free_from <= first]
        large = [b for b in free if b.floats >= floats]
        if large:
            buffer = min(large, key=lambda b: b.floats)
        elif free:
            buffer = max(free, key=lambda b: b.floats)
        else:
            buffer = SharedBuffer(0, [], 0)
            buffers.append(buffer)
        buffer.add(name, floats, last)
    return buffers


class WorkspacePlan:
    """What a network of these layers needs for images of `size` = (height, width), forward alone or
    with the backward pass (training).

    blocking: of the convolutions' kernels. convolutions: {(layer, direction, source): module} that
    the policy chose. shapes: {name: shape} of the outputs and of their gradients, that of x and its
    own among them. Raises UserError where no variant is as exact as the policy's tolerance.
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
        self.layers, self.size, self.blocking = layers, size, policy.blocking
        height, width = size
        shapes = {n: (height >> level, width >> level) for n, level in levels_of(layers).items()}
        channels = {"x": sum(layers[0].sources)} | {x.name: x.channels for x in layers}
        outputs = {name: (*shape, channels[name]) for name, shape in shapes.items()}
        self.shapes = outputs | {gradient_of(name): shape for name, shape in outputs.items()}
        self.shared: list[SharedBuffer] = plan_buffers(lifetimes(layers, training), self.shapes)
        self.convolutions: dict[tuple, ModuleType] = {}
        self.work_floats = [COUNTERS, 1]
        parameters = parameter_table(layers)
        for layer in convolutions(layers):
            rows, columns = shapes[layer.name]
            weight_shape, _ = parameters[layer.name + ".weight"]
            for direction, source in computations(layer, training):
                shape = ConvShape(
                    direction,
                    layer.kernel_size,
                    layer.sources,
                    layer.channels,
                    rows * columns,
                    source,
                )
                conv = policy.convolution(shape)
                self.convolutions[layer.name, direction, source] = conv
                needs = conv.work_floats(
                    dev, self.blocking, direction, rows, weight_shape, shape.ci
                )
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
    """The buffers of a plan.

    plan: the one that is followed. arrays: {name: array} of the outputs and of their gradients
    (layers.gradient_of), without x; some share a buffer, one after the other. work: of the
    convolutions.
    """

    def __init__(self, dev: Device):
        self.dev = dev
        self.plan: WorkspacePlan | None = None
        self.arrays: dict[str, Array] = {}
        self._buffers: list[Array | None] = []
        self._arrays_of = {}  # {plan: arrays} in the present buffers
        self._all_tiles = None
        self.work = Work.empty(dev)

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
