"""The network against float64, its buffers, and what is refused."""

import dataclasses
import math

import numpy as np
import pytest
from oracle.unet import unet, unet_gradients
from support.comparisons import relative_error
from support.networks import plain_parameters

from pp_cl.layers.choice import make_policy
from pp_cl.network.layers import BLOCKS, convolutions, multiplications, unet_layers
from pp_cl.network.unet import UNet
from pp_cl.reference.differences import numeric_gradient
from pp_cl.settings import NetworkConfig


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
    net = UNet(dev, widths, blocks=blocks, seed=1, policy=make_policy(dev, variant=variant))
    x, grad_y = normal(rng, 12, 16, 16), normal(rng, 12, 16, 3)
    parameters = plain_parameters(net, net.parameters)
    inference = net.forward(dev.upload(x), training=False).get()
    y = net.forward(dev.upload(x)).get()
    np.testing.assert_array_equal(inference, y)
    grad_x = net.backward(dev.upload(grad_y)).get()
    expected_x, expected = unet_gradients(x, parameters, grad_y, blocks)
    assert relative_error(y, unet(x, parameters, blocks)[0]) < 3e-6
    assert relative_error(grad_x, expected_x) < 1e-5
    gradients = plain_parameters(net, net.gradients)
    assert gradients.keys() == expected.keys()
    for name, gradient in gradients.items():
        assert relative_error(gradient, expected[name]) < 1e-5, name


@pytest.mark.parametrize("blocks", BLOCKS)
def test_gradients_by_finite_differences(dev, rng, blocks):
    """Steps this small cross no kink of a ReLU: but for gates the network is piecewise linear, so
    the differences are exact there.
    """
    net = UNet(dev, (4, 5, 6), channels_in=3, blocks=blocks, seed=2)
    x, grad_y = normal(rng, 8, 4, 3), normal(rng, 8, 4, 3)
    parameters = plain_parameters(net, net.parameters)
    net.forward(dev.upload(x))
    grad_x = net.backward(dev.upload(grad_y)).get()

    def loss(values, changed):
        return (unet(x, parameters | {changed: values}, blocks)[0] * grad_y).sum()

    numeric = numeric_gradient(lambda v: (unet(v, parameters, blocks)[0] * grad_y).sum(), x, 1e-5)
    assert relative_error(grad_x.ravel(), numeric) < 5e-6
    gradients = plain_parameters(net, net.gradients)
    for name, values in parameters.items():
        flat = gradients[name].ravel()
        some = [*np.argsort(-np.abs(flat))[:6], *rng.integers(0, flat.size, 6)]
        numeric = numeric_gradient(lambda v, name=name: loss(v, name), values, 1e-5, some)
        assert relative_error(flat[some], numeric) < 5e-6, name


@pytest.mark.parametrize("variant", ["direct", "winograd"])
def test_frozen_weights_are_laid_out_once(dev, rng, variant):
    net = UNet(dev, seed=3, policy=make_policy(dev, variant=variant))
    small, large = (dev.upload(normal(rng, *size, 16)) for size in ((16, 12), (32, 36)))
    expected = [net.forward(x, training=False).get() for x in (small, large)]
    net.freeze()
    for _ in range(2):
        for x, image in zip((small, large), expected, strict=True):
            np.testing.assert_array_equal(net.forward(x, training=False).get(), image)
    net.parameters["enc1.a.weight"].fill(0)  # forbidden, and unseen where the weights are laid out
    assert np.array_equal(net.forward(large, training=False).get(), expected[1]) == (
        variant != "direct"
    )
    with pytest.raises(RuntimeError, match="freeze"):
        net.forward(small)


def test_sizes_and_variants_may_change_between_images(dev, rng):
    net = UNet(dev, (16, 32, 48), seed=1)
    for variant, size in (("winograd", (12, 16)), ("direct", (4, 8)), ("local", (16, 12))) * 2:
        x, grad_y = (dev.upload(normal(rng, *size, channels)) for channels in (16, 3))
        alone = UNet(dev, (16, 32, 48), seed=1, policy=make_policy(dev, variant=variant))
        net.policy = alone.policy
        net.forward(dev.zeros((20, 8, 16)), training=False)
        np.testing.assert_array_equal(net.forward(x).get(), alone.forward(x).get())
        np.testing.assert_array_equal(net.backward(grad_y).get(), alone.backward(grad_y).get())


def test_same_bits_twice_and_for_equal_seeds(dev, rng):
    x, grad_y = (dev.upload(normal(rng, 32, 36, channels)) for channels in (16, 3))
    runs = []
    for seed in (5, 5, 6):
        net = UNet(dev, (16, 32, 64), seed=seed)
        y = net.forward(x).get()
        runs.append([y, net.backward(grad_y).get(), *[g.get() for g in net.gradients.values()]])
    for first, second in zip(runs[0], runs[1], strict=True):
        np.testing.assert_array_equal(first, second)
    assert not np.array_equal(runs[0][0], runs[2][0])


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
    "variant, blocks",
    [("direct", "double"), ("winograd", "double"), ("auto", "single"), ("local", "gated")],
)
@pytest.mark.parametrize("training", [False, True])
def test_memory_plan_is_what_is_allocated(plain, training, variant, blocks):
    x, grad_y = plain.zeros((16, 20, 16)), plain.zeros((16, 20, 3))
    before = plain.bytes
    policy = make_policy(plain, variant=variant)
    net = UNet(plain, (16, 32, 48), blocks=blocks, policy=policy)
    net.forward(x, training)
    if training:
        net.backward(grad_y)
    assert plain.bytes - before == sum(row[2] for row in net.memory_plan(16, 20, training))


@pytest.mark.parametrize(
    "blocks, parameters, operations",
    [("double", 6_968_579, 966e9), ("single", 3_133_443, 494e9), ("gated", 6_102_275, 978e9)],
)
def test_size_of_the_papers_network(blocks, parameters, operations):
    """The parameters worked out by hand, and the multiplications at 800x800, with the 1x1
    convolutions before the upsampling.
    """
    layers = unet_layers((128, 256, 512), blocks=blocks)
    shapes = [layer.weight_shape() for layer in convolutions(layers)]
    assert sum(math.prod(shape) + shape[0] for shape in shapes) == parameters
    assert multiplications(layers, 800, 800) == pytest.approx(operations, rel=1e-3)


def test_the_setting_names_the_blocks():
    (item,) = (f for f in dataclasses.fields(NetworkConfig) if f.name == "blocks")
    assert item.default == "single" and item.metadata["choices"] == tuple(BLOCKS)


def test_memory_of_the_papers_network(dev):
    net = UNet(dev, (128, 256, 512))
    inference, training = net.memory_plan(800, 800, False), net.memory_plan(800, 800, True)
    assert sum(row[2] for row in inference) < 1.5e9
    assert sum(row[2] for row in training) < 5e9
    assert max(row[2] for row in inference + training) <= 1 << 30
