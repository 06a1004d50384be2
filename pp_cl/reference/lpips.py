"""Float64 numpy twin of LPIPS v0.1 with VGG16."""

from typing import Any

import numpy as np

from pp_cl.reference.network import convolution, flipped

Weights = dict[str, np.ndarray]

BLOCKS = (2, 2, 3, 3, 3)
WIDTHS = (16, 16, 32, 32, 48)  # channels of the blocks of a network small enough for numpy


def scaled_input(image: np.ndarray) -> np.ndarray:
    """Network input of an image in [0, 1], (..., 3)."""
    return (2 * image - 1 - np.array([-0.030, -0.088, -0.188])) / np.array([0.458, 0.448, 0.450])


def maxpool2(x: np.ndarray) -> np.ndarray:
    """Largest value of each 2x2 cell; an odd last row or column is dropped."""
    height, width, channels = x.shape[0] // 2, x.shape[1] // 2, x.shape[2]
    return x[: 2 * height, : 2 * width].reshape(height, 2, width, 2, channels).max(axis=(1, 3))


def maxpool2_gradient(x: np.ndarray, grad_out: np.ndarray) -> np.ndarray:
    """(H, W, C), (H // 2, W // 2, C) -> (H, W, C): at the largest of a cell, the first of equal
    ones.
    """
    grad_x = np.zeros(x.shape)
    for row, column, c in np.ndindex(grad_out.shape):
        cell = x[2 * row : 2 * row + 2, 2 * column : 2 * column + 2, c]
        y, z = np.unravel_index(cell.argmax(), (2, 2))
        grad_x[2 * row + y, 2 * column + z, c] = grad_out[row, column, c]
    return grad_x


def pixel_distance(a: np.ndarray, b: np.ndarray, head: np.ndarray) -> np.ndarray:
    """Weighted squared distance of the unit feature vectors of each pixel; a, b (..., C)."""
    unit_a = a / (np.sqrt((a**2).sum(axis=-1, keepdims=True)) + 1e-10)
    unit_b = b / (np.sqrt((b**2).sum(axis=-1, keepdims=True)) + 1e-10)
    return ((unit_a - unit_b) ** 2) @ head


def _features(image, weights):
    """(input of each convolution, output of each block) of an image in [0, 1]."""
    x, inputs, outputs = scaled_input(image), [], []
    for block, convolutions in enumerate(BLOCKS):
        x = maxpool2(x) if block else x
        for _ in range(convolutions):
            layer = len(inputs)
            inputs.append(x)
            x = convolution(x, weights[f"kernel{layer}"], weights[f"bias{layer}"])
            x = np.maximum(x, 0)
        outputs.append(x)
    return inputs, outputs


def lpips(a: np.ndarray, b: np.ndarray, weights: Weights) -> float:
    """Distance of two (H, W, 3) images in [0, 1]; weights as pp_cl.lpips_weights.load_weights()
    names them.
    """
    pairs = zip(_features(a, weights)[1], _features(b, weights)[1], strict=True)
    return sum(
        pixel_distance(x, y, weights[f"head{block}"]).mean() for block, (x, y) in enumerate(pairs)
    )


def pixel_distance_gradient(a: np.ndarray, b: np.ndarray, head: np.ndarray) -> np.ndarray:
    """Gradient of pixel_distance(a, b, head).sum() by a; 0 at pixels without features."""
    length = np.sqrt((a**2).sum(axis=-1, keepdims=True))
    unit_a = a / (length + 1e-10)
    unit_b = b / (np.sqrt((b**2).sum(axis=-1, keepdims=True)) + 1e-10)
    by_unit = 2 * head * (unit_a - unit_b)
    turned = (by_unit * a).sum(axis=-1, keepdims=True) / np.where(length > 0, length, np.inf)
    return by_unit / (length + 1e-10) - turned * a / (length + 1e-10) ** 2


def lpips_gradient(a: np.ndarray, b: np.ndarray, weights: Weights) -> np.ndarray:
    """Gradient of lpips(a, b, weights) by a, (H, W, 3)."""
    (inputs, features_a), (_, features_b) = _features(a, weights), _features(b, weights)
    layer = len(inputs)
    grad: Any = None
    for block in reversed(range(len(BLOCKS))):
        x, y = features_a[block], features_b[block]
        here = pixel_distance_gradient(x, y, weights[f"head{block}"]) / (x.shape[0] * x.shape[1])
        grad = here if grad is None else here + maxpool2_gradient(x, grad)
        for _ in range(BLOCKS[block]):
            layer -= 1
            grad_out, kernel = grad * (x > 0), weights[f"kernel{layer}"]
            x = inputs[layer]
            grad = convolution(grad_out, flipped(kernel))
    return grad * 2 / np.array([0.458, 0.448, 0.450])


def random_weights(rng: np.random.Generator) -> Weights:
    """Weights of VGG16's shape with few channels; He's deviation keeps the features alive."""
    weights, channels, layer = {}, 3, 0
    for block, (convolutions, width) in enumerate(zip(BLOCKS, WIDTHS, strict=True)):
        for _ in range(convolutions):
            deviation = np.sqrt(2 / (9 * channels))
            weights[f"kernel{layer}"] = rng.normal(0, deviation, (width, channels, 3, 3)).astype(
                np.float32
            )
            weights[f"bias{layer}"] = rng.normal(0, 0.1, width).astype(np.float32)
            channels, layer = width, layer + 1
        weights[f"head{block}"] = rng.uniform(0, 1, width).astype(np.float32)
    return weights
