"""Which arrays of a network can share a buffer, one after the other: assignment by liveness."""

import math
from dataclasses import dataclass

from pp_cl.network.layer import Layer


def gradient_of(name: str) -> str:
    """The name of the array that holds the gradient of a layer's output, or of a parameter."""
    return f"grad {name}"


def lifetimes(layers: list[Layer], training: bool) -> list[tuple[str, int, int]]:
    """[(name, first, last)] of a network's arrays, in layers of its forward and backward pass, by
    first use.

    The network's input "x" is not among them: it belongs to the caller.
    """
    schedule = [(*layer.inputs, layer.name) for layer in layers]
    if training:
        for layer in reversed(layers):
            read = layer.inputs if layer.reads_input_backward else ()
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
