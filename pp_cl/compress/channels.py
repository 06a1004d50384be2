"""Finds channels of a trained network that hardly contribute, such as those of a ReLU that is
always 0, and removes them with all that only computes or reads them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pp_cl.layers.conv_direct import pack_bias, pack_weights, unpack_weights
from pp_cl.layers.tiles import VECTOR
from pp_cl.network.layers import Layer, convolutions
from pp_cl.network.unet import UNet
from pp_cl.run import Run
from pp_cl.scene.camera import Camera

MEASURED_VIEWS = 16

Parameters = dict[str, np.ndarray]  # as UNet.parameters


def channel_weights(run: Run, cameras: Sequence[Camera]) -> Parameters:
    """{layer: (C,) float64} of the convolutions with ReLU: the root mean square of each channel
    over the pixels of some of the cameras, times the norm of the weights that read it. Nothing
    where the network has gates: theirs are two channels of a convolution.
    """
    layers = run.model.net.layers
    if any(layer.kind == "gate" for layer in layers):
        return {}
    # a copy, which keeps what its layers put out
    net = UNet.of_settings(run.dev, run.config.network)
    for name, parameter in net.parameters.items():
        run.dev.copy(parameter, run.model.net.parameters[name])
    found = {x.name: np.zeros(x.channels) for x in convolutions(layers) if x.relu}
    some = list(cameras)[:: -(-len(cameras) // MEASURED_VIEWS)]
    for camera in some:
        net.forward(
            run.renderer.forward(camera, run.gamma, until="features").features, training=True
        )
        for name, squares in found.items():
            squares += np.mean(net.output(name).get().astype(np.float64) ** 2, axis=(0, 1))
    parameters = {name: array.get() for name, array in net.parameters.items()}
    read = _norms_of_readers(layers, parameters)
    return {name: np.sqrt(s / len(some)) * read[name] for name, s in found.items()}


def _norms_of_readers(layers, parameters):
    """{layer: (C,)}: the norm of all weights that read a channel, through pooling too."""
    squares = {layer.name: np.zeros(layer.channels) for layer in layers}
    for layer in reversed(layers):
        if layer.kind == "conv":
            weight = unpack_weights(parameters[f"{layer.name}.weight"], layer.channels)
            read = (weight.astype(np.float64) ** 2).sum((0, 2, 3))
            parts = np.split(read, np.cumsum(layer.sources)[:-1])
        else:
            parts = [squares[layer.name]]
        for name, part in zip(layer.inputs, parts, strict=True):
            if name != "x":
                squares[name] += part
    return {name: np.sqrt(s) for name, s in squares.items()}


def kept_channels(
    layers: Sequence[Layer], weights: Parameters, least: float
) -> dict[str, np.ndarray]:
    """{layer: indices, ascending} of what each layer computes still: of a convolution with ReLU the
    channels that weigh at least so much of its heaviest, and more up to whole lanes of 16.
    """
    kept = {}
    for layer in layers:
        if layer.name in weights:
            weight = weights[layer.name]
            count = int((weight >= least * weight.max()).sum()) if least > 0 else len(weight)
            count = min(-(-max(1, count) // VECTOR) * VECTOR, len(weight))
            kept[layer.name] = np.sort(np.argsort(-weight, kind="stable")[:count])
        elif layer.kind == "pool" and layer.inputs[0] in kept:
            kept[layer.name] = kept[layer.inputs[0]]
        else:
            kept[layer.name] = np.arange(layer.channels)
    return kept


def reduced_parameters(
    layers: Sequence[Layer], parameters: Parameters, kept: dict[str, np.ndarray]
) -> Parameters:
    """The parameters of the network that computes the kept channels alone."""
    reduced = {}
    for layer in convolutions(list(layers)):
        weight = unpack_weights(parameters[f"{layer.name}.weight"], layer.channels)
        starts = np.cumsum([0, *layer.sources])
        read = [
            start + (kept[name] if name in kept else np.arange(size))
            for name, start, size in zip(layer.inputs, starts, layer.sources, strict=False)
        ]
        weight = weight[kept[layer.name]][:, np.concatenate(read)]
        reduced[f"{layer.name}.weight"] = pack_weights(weight)
        bias = parameters[f"{layer.name}.bias"][: layer.channels]
        reduced[f"{layer.name}.bias"] = pack_bias(bias[kept[layer.name]])
    return reduced
