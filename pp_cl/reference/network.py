"""Float64 convolutions and U-Nets in numpy, against which `pp-cl bench` measures errors."""

from collections import defaultdict
from typing import Any

import numpy as np


def convolution(x: np.ndarray, weight: np.ndarray, bias: np.ndarray | float = 0.0) -> np.ndarray:
    """(H, W, CO) convolution of x (H, W, CI) by weight (CO, CI, K, K), padded by zeros."""
    out = np.zeros((x.shape[0] * x.shape[1], len(weight)))
    for ky, kx, inputs in _taps(x, weight.shape[2]):
        out += inputs @ weight[:, :, ky, kx].T.astype(np.float64, order="C")
    return out.reshape(*x.shape[:2], -1) + bias


def flipped(weight: np.ndarray) -> np.ndarray:
    """(CI, CO, K, K) weights with which a convolution turns dL/dout into dL/dx."""
    return weight.transpose(1, 0, 2, 3)[:, :, ::-1, ::-1]


def convolution_backward_weights(x: np.ndarray, grad_out: np.ndarray, k: int) -> np.ndarray:
    """(CO, CI, K, K) gradient of the weights, given x (H, W, CI) and grad_out (H, W, CO)."""
    columns = grad_out.reshape(-1, grad_out.shape[2]).astype(np.float64).T
    gradient = np.empty((len(columns), x.shape[2], k, k))
    for ky, kx, inputs in _taps(x, k):
        gradient[:, :, ky, kx] = columns @ inputs
    return gradient


def _taps(x, k):
    """Yield (ky, kx, (H W, CI) float64: the input that this tap gives each pixel)."""
    height, width, channels = x.shape
    around = (k // 2, k // 2)
    padded = np.pad(np.asarray(x, np.float64), (around, around, (0, 0)))
    for ky in range(k):
        for kx in range(k):
            yield ky, kx, padded[ky : ky + height, kx : kx + width].reshape(-1, channels)


def gate(x: np.ndarray) -> np.ndarray:
    """(H, W, C): ELU of the first C channels of x (H, W, 2 C) times the sigmoid of the others."""
    features, gates = np.split(x, 2, 2)
    return _elu(features) * _sigmoid(gates)


def gate_backward(x: np.ndarray, grad_out: np.ndarray) -> np.ndarray:
    """(H, W, 2 C) gradient of gate()'s input, given the gradient (H, W, C) of its output."""
    features, gates = np.split(x, 2, 2)
    derivative = np.exp(np.minimum(features, 0))
    grad_features = grad_out * derivative * _sigmoid(gates)
    grad_gates = grad_out * _elu(features) * _sigmoid(gates) * _sigmoid(-gates)
    return np.concatenate([grad_features, grad_gates], 2)


def pool(x: np.ndarray) -> np.ndarray:
    """(H / 2, W / 2, C): means of 2 x 2 pixels of x (H, W, C)."""
    return x.reshape(x.shape[0] // 2, 2, x.shape[1] // 2, 2, -1).mean((1, 3))


def pool_backward(grad_out: np.ndarray) -> np.ndarray:
    """(2 H, 2 W, C) gradient of pool()'s input, given the gradient (H, W, C) of its output."""
    return 0.25 * grad_out.repeat(2, 0).repeat(2, 1)


def upsample(x: np.ndarray) -> np.ndarray:
    """(2 H, 2 W, C): x (H, W, C) enlarged bilinearly, with the border repeated."""
    return _along_both(_bilinear(x.shape[0]), _bilinear(x.shape[1]), x)


def upsample_backward(grad_out: np.ndarray) -> np.ndarray:
    """(H, W, C) gradient of upsample()'s input, given the gradient (2 H, 2 W, C) of its output."""
    height, width = grad_out.shape[:2]
    return _along_both(_bilinear(height // 2).T, _bilinear(width // 2).T, grad_out)


def network(layers: list, parameters: dict, x: np.ndarray) -> dict[str, np.ndarray]:
    """{layer: its output} of a network; "image" is the image, "x" the input (H, W, C). layers: as
    from unet_layers(). parameters: {"enc0.a.weight": (CO, CI, K, K), "enc0.a.bias": (CO,), ...}.
    """
    outputs = {"x": np.asarray(x, np.float64)}
    for layer in layers:
        outputs[layer.name] = _forward(layer, _joined(layer, outputs), parameters)
    outputs["image"] = 0.5 + 0.5 * outputs[layers[-1].name]
    return outputs


def network_gradients(
    layers: list, parameters: dict, outputs: dict, active: dict, *, grad_image: np.ndarray
) -> dict[str, np.ndarray]:
    """{"x" or parameter: its gradient}, given the outputs of network() and dL/dimage (H, W, 3).
    active: {layer: bool array, where its ReLU passes the gradient}, from the network under test:
    near 0, a single value that it rounds otherwise weighs more than the rounding of all others.
    """
    gradients: dict[str, Any] = {}  # of parameters
    grads: dict[str, Any] = defaultdict(float)  # of outputs, summed over their uses
    grads[layers[-1].name] = 0.5 * np.asarray(grad_image, np.float64)
    for layer in reversed(layers):
        grad = grads.pop(layer.name)
        if layer.relu:
            grad = grad * active[layer.name]
        source = _joined(layer, outputs)
        grad_source, of_parameters = _backward(layer, source, grad, parameters)
        gradients |= of_parameters
        first = 0
        for name in layer.inputs:
            channels = outputs[name].shape[2]
            grads[name] = grads[name] + grad_source[..., first : first + channels]
            first += channels
    return gradients | {"x": grads["x"]}


def _forward(layer, source, parameters):
    """The layer's output, given its concatenated inputs (H, W, CI)."""
    if layer.kind != "conv":
        return {"gate": gate, "pool": pool, "upsample": upsample}[layer.kind](source)
    weight, bias = parameters[layer.name + ".weight"], parameters[layer.name + ".bias"]
    out = convolution(source, weight, bias)
    return np.maximum(out, 0) if layer.relu else out


def _backward(layer, source, grad_out, parameters):
    """(gradient of the joined inputs, {parameter: its gradient}). grad_out: before the ReLU."""
    if layer.kind == "gate":
        return gate_backward(source, grad_out), {}
    if layer.kind != "conv":
        backward = {"pool": pool_backward, "upsample": upsample_backward}[layer.kind]
        return backward(grad_out), {}
    gradients = {
        layer.name + ".weight": convolution_backward_weights(source, grad_out, layer.kernel_size),
        layer.name + ".bias": grad_out.sum((0, 1)),
    }
    return convolution(grad_out, flipped(parameters[layer.name + ".weight"])), gradients


def _joined(layer, outputs):
    return np.concatenate([outputs[name] for name in layer.inputs], 2)


def _elu(x):
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def _sigmoid(x):
    decay = np.exp(-np.abs(x))
    return np.where(x >= 0, 1, decay) / (1 + decay)


def _bilinear(n):
    """(2n, n) matrix that doubles a line with weights 3/4 and 1/4 and repeats the border."""
    matrix = np.zeros((2 * n, n))
    for i in range(2 * n):
        matrix[i, i // 2] += 0.75
        matrix[i, np.clip(i // 2 - 1 + 2 * (i % 2), 0, n - 1)] += 0.25
    return matrix


def _along_both(rows, columns, x):
    return np.einsum("Yy,Xx,yxc->YXc", rows, columns, x, optimize=True)


def specular_inputs(features: np.ndarray, directions: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(..., 58): what the specular layer gets of pixels with these features (..., 16), unit
    directions (..., 3) and places (..., 3), encoded as in cl/layers/specular.h.
    """
    encoded = [features]
    for values, octaves in ((directions, 4), (places, 2)):
        angles = [2.0**k * np.pi / 2 * values for k in range(octaves)]
        encoded += [values, *(wave(angle) for angle in angles for wave in (np.sin, np.cos))]
    return np.concatenate(encoded, -1)


def specular(layers: list, parameters: dict, *of_pixels: np.ndarray) -> np.ndarray:
    """(H, W, 3) colour that the specular layer adds to pixels of alpha 1. layers, parameters: as in
    network(). of_pixels: as for specular_inputs(), (H, W, ...).
    """
    x = specular_inputs(*of_pixels)
    return network(layers, parameters, x)["image"] - 0.5
