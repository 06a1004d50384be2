"""Arrays that share a buffer never live at the same time."""

from itertools import pairwise

import numpy as np

from pp_cl.network.layers import gradient_of, unet_layers
from pp_cl.network.workspace import lifetimes, plan_buffers


def test_arrays_of_one_buffer_never_overlap(rng):
    firsts = np.sort(rng.integers(0, 20, 40))
    lifetimes = [(i, first, first + rng.integers(0, 6)) for i, first in enumerate(firsts)]
    shapes = {i: (rng.integers(1, 9), 3) for i in range(40)}
    buffers = plan_buffers(lifetimes, shapes)
    assert sorted(name for buffer in buffers for name in buffer.names) == list(range(40))
    assert len(buffers) < 20
    for buffer in buffers:
        held = [lifetimes[name] for name in buffer.names]
        assert all(a[2] < b[1] for a, b in pairwise(held))
        assert buffer.floats == max(np.prod(shapes[name]) for name in buffer.names)


def test_lifetimes_of_the_network():
    layers = unet_layers((16, 32, 48), 3)
    inference, training = (
        {name: span for name, *span in lifetimes(layers, t)} for t in (False, True)
    )
    # the skip lives longest
    assert inference["enc0.b"] == [1, 14] and inference["enc0.a"] == [0, 1]
    assert "x" not in training and set(inference) == {layer.name for layer in layers}
    assert (
        training["out"][1] == 2 * len(layers)
        and training[gradient_of("x")][1] == 2 * len(layers) - 1
    )
    assert training["enc0.a"][1] > training["enc0.b"][1] - 2  # read again by the backward pass
    gated = {n: s for n, *s in lifetimes(unet_layers((16, 32, 48), 3, blocks="gated"), True)}
    # the gate's backward pass reads its input
    assert gated["enc0.a"] == [0, 2 * len(layers) - 2]
    assert training["up0"] == [12, 13]  # enlarging needs nothing of its input
