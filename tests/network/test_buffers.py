"""pp_cl/network/buffers.py: arrays that share a buffer never live at the same time."""

import numpy as np

from pp_cl.network.buffers import assign_slots, lifetimes
from pp_cl.network.unet import unet_steps


def test_slots_never_overlap(rng):
    firsts = np.sort(rng.integers(0, 20, 40))
    lifetimes = [(i, first, first + rng.integers(0, 6)) for i, first in enumerate(firsts)]
    shapes = {i: (rng.integers(1, 9), 3) for i in range(40)}
    slots = assign_slots(lifetimes, shapes)
    assert sorted(name for slot in slots for name in slot.names) == list(range(40))
    assert len(slots) < 20
    for slot in slots:
        held = [lifetimes[name] for name in slot.names]
        assert all(a[2] < b[1] for a, b in zip(held, held[1:], strict=False))
        assert slot.floats == max(np.prod(shapes[name]) for name in slot.names)


def test_lifetimes_of_the_network():
    steps = unet_steps((16, 32, 48), 3)
    inference, training = (
        {name: span for name, *span in lifetimes(steps, t)} for t in (False, True)
    )
    # the skip lives longest
    assert inference["enc0.b"] == [1, 14] and inference["enc0.a"] == [0, 1]
    assert "x" not in training and set(inference) == {s.name for s in steps}
    assert training["out"][1] == 2 * len(steps) and training["grad x"][1] == 2 * len(steps) - 1
    assert training["enc0.a"][1] > training["enc0.b"][1] - 2  # read again by the backward pass
    assert training["up0"] == [12, 13]  # enlarging needs nothing of its input
