"""Float64 numpy twin of LPIPS v0.1 with VGG16."""

import numpy as np

from pp_cl.reference.network import convolution

Weights = dict[str, np.ndarray]

BLOCKS = (2, 2, 3, 3, 3)
WIDTHS = (16, 16, 32, 32, 48)  # channels of the blocks of a network small enough for numpy


def maxpool2(x: np.ndarray) -> np.ndarray:
    """The largest value of each 2x2 cell; an odd last row or column is dropped."""
    height, width, channels = x.shape[0] // 2, x.shape[1] // 2, x.shape[2]
    return x[: 2 * height, : 2 * width].reshape(height, 2, width, 2, channels).max(axis=(1, 3))


def pixel_distance(a: np.ndarray, b: np.ndarray, head: np.ndarray) -> np.ndarray:
    """(...) weighted squared distances between the pixels' unit feature vectors; a, b: (..., C)."""
    unit_a = a / (np.sqrt((a**2).sum(axis=-1, keepdims=True)) + 1e-10)
    unit_b = b / (np.sqrt((b**2).sum(axis=-1, keepdims=True)) + 1e-10)
    return ((unit_a - unit_b) ** 2) @ head


def _features(image, weights):
    """The output of each block for an image in [0, 1]."""
    x = (2 * image - 1 - np.array([-0.030, -0.088, -0.188])) / np.array([0.458, 0.448, 0.450])
    layer, outputs = 0, []
    for block, convolutions in enumerate(BLOCKS):
        x = maxpool2(x) if block else x
        for _ in range(convolutions):
            x = convolution(x, weights[f"kernel{layer}"], weights[f"bias{layer}"])
            x, layer = np.maximum(x, 0), layer + 1
        outputs.append(x)
    return outputs


def lpips(a: np.ndarray, b: np.ndarray, weights: Weights) -> float:
    """LPIPS of two (H, W, 3) images in [0, 1]. weights: with the names of load_weights()."""
    pairs = zip(_features(a, weights), _features(b, weights), strict=True)
    return sum(
        pixel_distance(x, y, weights[f"head{block}"]).mean() for block, (x, y) in enumerate(pairs)
    )


def random_weights(rng: np.random.Generator) -> Weights:
    """Random weights for VGG16's layers with few channels; He's deviation keeps features alive."""
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
