"""Buffers that hold one array after another: which of a network's arrays can share one."""

from dataclasses import dataclass

import numpy as np


def lifetimes(steps, training):
    """[(name, first, last)] of the arrays of a network, in steps of its forward and backward pass,
    by first use.

    steps: unet.Step. The input and the passes' gradients are named as in unet.UNet; the input
    itself is the caller's.
    """
    schedule = [(*step.inputs, step.name) for step in steps]
    if training:
        for step in reversed(steps):
            activations = () if step.kind == "up" else step.inputs
            schedule.append(
                (*activations, "grad " + step.name, *("grad " + name for name in step.inputs))
            )
    found = {}
    for time, names in enumerate(schedule):
        for name in names:
            found[name] = (found.get(name, (time,))[0], time)
    del found["x"]
    last = steps[-1].name
    found[last] = (found[last][0], len(schedule))  # the caller may read it after backward
    return [(name, *lifetime) for name, lifetime in found.items()]


@dataclass
class Slot:
    """One buffer that holds several arrays, one after the other."""

    floats: int
    names: list
    free_from: int


def assign_slots(lifetimes, shapes):
    """[Slot] such that no two arrays of one slot live at the same time.

    lifetimes: [(name, first, last)] by first use. An array takes the free slot that fits it best;
    if none is large enough, the largest free one grows.
    """
    slots = []
    for name, first, last in lifetimes:
        floats = int(np.prod(shapes[name]))
        free = [s for s in slots if s.free_from <= first]
        large = [s for s in free if s.floats >= floats]
        if free:
            slot = (
                min(large, key=lambda s: s.floats) if large else max(free, key=lambda s: s.floats)
            )
        else:
            slot = Slot(0, [], 0)
            slots.append(slot)
        slot.floats = max(slot.floats, floats)
        slot.names.append(name)
        slot.free_from = last + 1
    return slots
