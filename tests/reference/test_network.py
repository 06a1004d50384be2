"""pp_cl/reference/network.py against the tests' own float64 twins, which are written another
way.
"""

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from oracle.unet import unet, unet_gradients
from support.comparisons import relative_error

from pp_cl.network.layers import BLOCKS, convolutions, unet_layers
from pp_cl.reference.network import (
    convolution,
    convolution_at,
    convolution_backward_weights,
    flipped,
    network,
    network_gradients,
)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("height, width, ci, co", [(1, 1, 1, 1), (5, 1, 3, 16), (6, 9, 20, 7)])
def test_convolution_and_its_gradients(rng, height, width, ci, co, k):
    x, grad_out = (rng.normal(size=(height, width, c)).astype(np.float32) for c in (ci, co))
    weight, bias = rng.normal(size=(co, ci, k, k)).astype(np.float32), rng.normal(size=co)
    expected, (grad_x, grad_weight, _) = conv(x, weight, bias), conv_gradients(x, weight, grad_out)
    assert relative_error(convolution(x, weight, bias), expected) < 1e-13
    assert relative_error(convolution(grad_out, flipped(weight)), grad_x) < 1e-13
    assert relative_error(convolution_backward_weights(x, grad_out, k), grad_weight) < 1e-13
    pixels = rng.integers(0, height, 12), rng.integers(0, width, 12)
    assert relative_error(convolution_at(x, weight, bias, pixels), expected[pixels]) < 1e-13


@pytest.mark.parametrize("blocks", BLOCKS)
def test_network_and_its_gradients(rng, blocks):
    widths, layers = (4, 5, 6), unet_layers((4, 5, 6), 7, 3, blocks)
    parameters = {}
    for layer in convolutions(layers):
        parameters |= {
            layer.name + ".weight": 0.2 * rng.normal(size=layer.weight_shape()),
            layer.name + ".bias": rng.normal(size=layer.channels),
        }
    x, grad_image = rng.normal(size=(8, 12, 7)), rng.normal(size=(8, 12, 3))
    outputs = network(layers, parameters, x)
    assert outputs["pool1"].shape == (2, 3, widths[1])
    assert relative_error(outputs["image"], unet(x, parameters, blocks)[0]) < 1e-13
    active = {name: values > 0 for name, values in outputs.items()}
    gradients = network_gradients(layers, parameters, outputs, active, grad_image=grad_image)
    expected_x, expected = unet_gradients(x, parameters, grad_image, blocks)
    assert relative_error(gradients.pop("x"), expected_x) < 1e-13
    assert gradients.keys() == expected.keys()
    for name, gradient in gradients.items():
        assert relative_error(gradient, expected[name]) < 1e-12, name
