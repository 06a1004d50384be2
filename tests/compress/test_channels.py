"""Channels that may go: what they weigh, and that nothing is lost with those that are dead."""

from dataclasses import replace

import numpy as np
import pytest
from support.comparisons import relative_error
from support.networks import plain_parameters

from pp_cl.compress.channels import kept_channels, reduced_parameters
from pp_cl.compress.reduction import Reduction
from pp_cl.layers.conv_direct import unpack_weights
from pp_cl.network.layers import convolutions
from pp_cl.network.unet import UNet
from pp_cl.reference.network import network

DEAD = {"enc0.b": 20, "enc1.a": 33, "enc2.b": 17, "dec1.a": 40, "dec0.b": 1}


def planted(dev, rng, blocks="double"):
    """A network in which so many channels of some layers never open, and their weights."""
    net = UNet(dev, (32, 48, 64), blocks=blocks, seed=3)
    weights = {}
    for layer in convolutions(net.layers):
        if layer.relu:
            weights[layer.name] = rng.uniform(0.5, 1, layer.channels)
            dead = rng.permutation(layer.channels)[: DEAD.get(layer.name, 0)]
            weights[layer.name][dead] = 0
            bias = net.parameters[f"{layer.name}.bias"]
            values = bias.get()
            values[dead] = -1e3
            bias.set(values)
    return net, weights


@pytest.mark.parametrize("blocks", ["double", "single"])
def test_dead_channels_go_for_nothing(dev, rng, blocks):
    """In whole lanes of 16; the smaller network is the float64 twin's of its parameters, too."""
    net, weights = planted(dev, rng, blocks)
    kept = kept_channels(net.layers, weights, 1e-3)
    parameters = {name: array.get() for name, array in net.parameters.items()}
    channels = [len(kept[layer.name]) for layer in convolutions(net.layers)[:-1]]
    small = UNet(dev, (32, 48, 64), blocks=blocks, channels=channels)
    for name, values in reduced_parameters(net.layers, parameters, kept).items():
        small.parameters[name].set(values)
    found = {layer.name: layer.channels for layer in convolutions(small.layers)}
    assert found["enc0.a"] == 32 and found["enc1.a"] == 16
    if blocks == "double":
        assert found["enc0.b"] == 16 and found["enc2.b"] == 48 and found["dec1.a"] == 16
        assert found["dec0.b"] == 32  # 31 take two lanes of 16
    x = rng.normal(size=(36, 44, 16)).astype(np.float32)
    whole, less = (n.forward(dev.upload(x), False).get() for n in (net, small))
    assert relative_error(less, whole) < 1e-6
    expected = network(small.layers, plain_parameters(small, small.parameters), x)["image"]
    assert relative_error(less, expected) < 3e-6


def test_all_channels_stay_as_they_are(dev, rng):
    net, weights = planted(dev, rng)
    kept = kept_channels(net.layers, weights, 0.0)
    parameters = {name: array.get() for name, array in net.parameters.items()}
    for name, values in reduced_parameters(net.layers, parameters, kept).items():
        assert np.array_equal(values, parameters[name])


def test_weights_are_of_what_is_put_out_and_read(original):
    """Of each channel, in float64: of the layer before the image, by hand."""
    run = original.run
    net, cameras = run.model.net, run.cameras("train")
    mean = 0.0
    parameters = plain_parameters(net, net.parameters)
    for camera in cameras:
        x = run.renderer.forward(camera, run.gamma, until="features").features.get()
        values = network(net.layers, parameters, x)["dec0.a"]
        mean = mean + np.mean(values**2, axis=(0, 1)) / len(cameras)
    out = unpack_weights(net.parameters["out.weight"].get(), 3)[:, :, 0, 0]
    expected = np.sqrt(mean * (out.astype(np.float64) ** 2).sum(0))
    assert relative_error(original.channel_weights["dec0.a"], expected) < 1e-4


def test_a_run_with_fewer_channels(original):
    """It is loaded, rendered and checked by its own settings."""
    run = original.reduced(replace(Reduction.of(original.run), channels=0.5))
    layers = convolutions(run.model.net.layers)
    assert run.config.network.channels.count(",") == len(layers) - 2
    assert run.config.network.channel_numbers == tuple(x.channels for x in layers[:-1])
    assert np.isfinite(run.render(run.cameras("train")[0]).colour).all()
