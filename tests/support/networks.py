"""A network's parameters in the plain layout of the oracles."""

import numpy as np
import pytest

from pp_cl.layers.conv_direct import unpack_weights


def plain_parameters(net, arrays):
    """{name: float64 array} in the oracle's layout; asserts that the padding is zero."""
    channels_of, plain = {layer.name: layer.channels for layer in net.layers}, {}
    for name, array in arrays.items():
        values, channels = array.get().astype(np.float64), channels_of[name.rsplit(".", 1)[0]]
        plain[name] = unpack_weights(values, channels) if values.ndim == 5 else values[:channels]
        assert np.abs(values).sum() == pytest.approx(np.abs(plain[name]).sum(), rel=1e-12)
    return plain
