import math

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.bench.unet import plain_parameters
from pp_cl.engine.network.layers import (
    convolutions,
    multiplications,
    unet_layers,
)
from pp_cl.engine.network.unet import UNet
from pp_cl.reference.network import network, network_gradients


def normal(rng, *shape):
    return rng.normal(size=shape).astype(np.float32)


@pytest.mark.parametrize(
    "widths, variant, blocks",
    [
        ((16, 32, 48), "direct", "double"),
        ((16, 32, 48), "winograd", "double"),
        ((20, 16, 40), "auto", "double"),
        ((16, 32, 48), "direct", "single"),
        ((20, 16, 40), "auto", "single"),
        ((3, 17, 5), "auto", "gated"),
    ],
)
def test_forward_and_backward(dev, rng, widths, variant, blocks):
    net = UNet(dev, widths, blocks=blocks, seed=1, variant=variant)
    x, grad_y = normal(rng, 12, 16, 16), normal(rng, 12, 16, 3)
    parameters = plain_parameters(net, net.parameters)
    inference = net.forward(dev.upload(x), training=False).get()
    y = net.forward(dev.upload(x)).get()
    np.testing.assert_array_equal(inference, y)
    grad_x, parts = net.backward(dev.upload(grad_y))
    grad_x, summed = grad_x.get(), net.sum_gradients(parts)
    outputs = network(net.layers, parameters, x)
    active = {name: values > 0 for name, values in outputs.items()}
    expected = network_gradients(net.layers, parameters, outputs, active, grad_image=grad_y)
    assert relative_error(y, outputs["image"]) < 3e-6
    gradients = plain_parameters(net, summed)
    for name, array in summed.items():  # the padding is 0
        assert np.count_nonzero(array.get()) == np.count_nonzero(gradients[name])
    gradients |= {"x": grad_x}
    assert gradients.keys() == expected.keys()
    for name, gradient in gradients.items():
        assert relative_error(gradient, expected[name]) < 1e-5, name


@pytest.mark.parametrize("variant", ["direct", "winograd"])
def test_frozen_weights_are_laid_out_once(dev, rng, variant):
    net = UNet(dev, seed=3, variant=variant)
    small, large = (dev.upload(normal(rng, *size, 16)) for size in ((16, 12), (32, 36)))
    expected = [net.forward(x, training=False).get() for x in (small, large)]
    net.freeze()
    for _ in range(2):
        for x, image in zip((small, large), expected, strict=True):
            np.testing.assert_array_equal(net.forward(x, training=False).get(), image)
    net.parameters["enc1.a.weight"].fill(0)  # forbidden, and not seen once weights are laid out
    assert np.array_equal(net.forward(large, training=False).get(), expected[1]) == (
        variant != "direct"
    )
    with pytest.raises(RuntimeError, match="freeze"):
        net.forward(small)


def test_sizes_may_change_between_images(dev, rng):
    net = UNet(dev, (16, 32, 48), seed=1)
    for size in ((12, 16), (4, 8), (36, 32)) * 2:
        x, grad_y = (dev.upload(normal(rng, *size, channels)) for channels in (16, 3))
        alone = UNet(dev, (16, 32, 48), seed=1)
        net.forward(dev.zeros((20, 8, 16)), training=False)
        np.testing.assert_array_equal(net.forward(x).get(), alone.forward(x).get())
        np.testing.assert_array_equal(
            net.backward(grad_y)[0].get(), alone.backward(grad_y)[0].get()
        )


def test_initial_values_are_pytorchs(dev):
    net = UNet(dev, (16, 32, 64), seed=0)
    for name, values in plain_parameters(net, net.parameters).items():
        layer = name.rsplit(".", 1)[0]
        weight = net.parameters[layer + ".weight"].shape
        bound = 1 / np.sqrt(weight[3] * weight[1] ** 2)
        assert np.abs(values).max() <= bound * (1 + 1e-6), name
        if values.size > 500:
            assert values.std() == pytest.approx(bound / np.sqrt(3), rel=0.1), name


def test_wrong_use_is_refused(dev):
    net = UNet(dev, (16, 16, 16))
    with pytest.raises(ValueError, match="\\(10, 8, 16\\)"):
        net.forward(dev.zeros((10, 8, 16)))
    with pytest.raises(ValueError, match="4n"):
        net.forward(dev.zeros((8, 8, 3)))
    net.forward(dev.zeros((8, 8, 16)), training=False)
    with pytest.raises(RuntimeError, match="forward"):
        net.backward(dev.zeros((8, 8, 3)))


@pytest.mark.parametrize(
    "blocks, parameters, operations",
    [("double", 6_968_579, 966e9), ("single", 3_133_443, 494e9), ("gated", 6_102_275, 978e9)],
)
def test_size_of_the_papers_network(blocks, parameters, operations):
    layers = unet_layers((128, 256, 512), blocks=blocks)
    shapes = [layer.weight_shape() for layer in convolutions(layers)]
    assert sum(math.prod(shape) + shape[0] for shape in shapes) == parameters
    assert multiplications(layers, 800, 800) == pytest.approx(operations, rel=1e-3)
