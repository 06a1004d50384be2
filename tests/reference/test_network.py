"""Test the layers' float64 twins against scipy's functions, and their gradients as adjoints or by
finite differences; the network's twin against one written out here, and its gradients by
differences.
"""

import numpy as np
import pytest
from scipy.ndimage import correlate, zoom
from scipy.special import expit
from support.comparisons import relative_error

from pp_cl.engine.network.layers import convolutions, unet_layers
from pp_cl.reference.differences import numeric_gradient
from pp_cl.reference.network import (
    convolution,
    convolution_backward_weights,
    flipped,
    gate,
    gate_backward,
    network,
    network_gradients,
    pool,
    pool_backward,
    upsample,
    upsample_backward,
)
from pp_cl.settings import BLOCKS


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("height, width, ci, co", [(1, 1, 1, 1), (5, 1, 3, 16), (6, 9, 20, 7)])
def test_convolution_and_its_gradients(rng, height, width, ci, co, k):
    x, grad_out = (rng.normal(size=(height, width, c)).astype(np.float32) for c in (ci, co))
    weight, bias = rng.normal(size=(co, ci, k, k)).astype(np.float32), rng.normal(size=co)
    out = convolution(x, weight, bias)
    wide = x.astype(np.float64), weight.astype(np.float64)
    for o in range(co):
        planes = [correlate(wide[0][..., i], wide[1][o, i], mode="constant") for i in range(ci)]
        assert relative_error(out[..., o], sum(planes) + bias[o]) < 1e-13
    # both gradients are adjoints, as the layer is linear in each input
    of_x, of_weight = (
        convolution(grad_out, flipped(weight)),
        convolution_backward_weights(x, grad_out, k),
    )
    product = ((out - bias) * grad_out).sum()
    assert (x * of_x).sum() == pytest.approx(product, rel=1e-9, abs=1e-9)
    assert (weight * of_weight).sum() == pytest.approx(product, rel=1e-9, abs=1e-9)


def test_pooling_and_upsampling(rng):
    small, large = rng.normal(size=(3, 5, 2)), rng.normal(size=(6, 10, 2))
    y, x = np.mgrid[:3, :5]
    cells = [large[2 * y + dy, 2 * x + dx] for dy in (0, 1) for dx in (0, 1)]
    assert relative_error(pool(large), np.mean(cells, 0)) < 1e-15
    assert (pool_backward(small) * large).sum() == pytest.approx((small * pool(large)).sum())
    wide = zoom(small, (2, 2, 1), order=1, mode="nearest", grid_mode=True)
    assert relative_error(upsample(small), wide) < 1e-15
    product = (upsample(small) * large).sum()
    assert (upsample_backward(large) * small).sum() == pytest.approx(product)


def test_gate(rng):
    x, grad_out = rng.normal(0, 2, (3, 4, 10)), rng.normal(size=(3, 4, 5))
    features, gates = x[..., :5], x[..., 5:]
    elu = np.where(features > 0, features, np.exp(features) - 1)
    assert relative_error(gate(x), elu * expit(gates)) < 1e-15
    numeric = numeric_gradient(lambda v: (gate(v) * grad_out).sum(), x, 1e-5)
    assert relative_error(gate_backward(x, grad_out).ravel(), numeric) < 1e-9


def unet(x, parameters, blocks):
    """(H, W, 3) image, computed layer by layer as in the paper. parameters: {"enc0.a.weight": (CO,
    CI, K, K), "enc0.a.bias": (CO,), ...}.
    """

    def layer(name, *sources, relu=True):
        weight, bias = parameters[name + ".weight"], parameters[name + ".bias"]
        out = convolution(np.concatenate(sources, 2), weight, bias)
        return np.maximum(out, 0) if relu else out

    def block(name, *sources):
        x = layer(name + ".a", *sources, relu=blocks != "gated")
        if blocks == "double":
            x = layer(name + ".b", x)
        return gate(x) if blocks == "gated" else x

    skip0 = block("enc0", np.asarray(x, np.float64))
    skip1 = block("enc1", pool(skip0))
    # as in the paper, enlarged before the 1x1 convolution: the result is the same
    up1 = layer("up1", upsample(block("enc2", pool(skip1))), relu=False)
    up0 = layer("up0", upsample(block("dec1", up1, skip1)), relu=False)
    return 0.5 + 0.5 * layer("out", block("dec0", up0, skip0), relu=False)


@pytest.mark.parametrize("blocks", BLOCKS)
def test_network_and_its_gradients(rng, blocks):
    """Steps this small cross no kink of a ReLU. Except for gates, the network is piecewise linear
    in each parameter, so the differences are exact there.
    """
    layers = unet_layers((4, 5, 6), 7, 3, blocks)
    parameters = {}
    for layer in convolutions(layers):
        parameters[layer.name + ".weight"] = 0.2 * rng.normal(size=layer.weight_shape())
        parameters[layer.name + ".bias"] = rng.normal(size=layer.channels)
    x, grad_image = rng.normal(size=(8, 12, 7)), rng.normal(size=(8, 12, 3))
    outputs = network(layers, parameters, x)
    assert outputs["pool1"].shape == (2, 3, 5)
    assert relative_error(outputs["image"], unet(x, parameters, blocks)) < 1e-13
    active = {name: values > 0 for name, values in outputs.items()}
    gradients = network_gradients(layers, parameters, outputs, active, grad_image=grad_image)
    assert gradients.keys() == parameters.keys() | {"x"}

    def loss(name, values):
        changed = parameters | {name: values}
        return (unet(changed.pop("x", x), changed, blocks) * grad_image).sum()

    for name, values in (parameters | {"x": x}).items():
        flat = gradients[name].ravel()
        indices = [*np.argsort(-np.abs(flat))[:4], *rng.integers(0, flat.size, 4)]
        numeric = numeric_gradient(lambda v, name=name: loss(name, v), values, 1e-6, indices)
        assert relative_error(flat[indices], numeric) < 1e-6, name
