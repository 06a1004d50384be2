"""Float64 numpy twin of LPIPS v0.1 with VGG16."""

import numpy as np
from oracle.conv import conv_gradients
from oracle.layers import maxpool2_gradient

BLOCKS = (2, 2, 3, 3, 3)
WIDTHS = (16, 16, 32, 32, 48)  # channels of the blocks of a network small enough for numpy


def scaled_input(image):
    """Network input of an image in [0, 1], (..., 3)."""
    return (2 * image - 1 - np.array([-0.030, -0.088, -0.188])) / np.array([0.458, 0.448, 0.450])


def convolve_relu(x, kernel, bias):
    """3x3 convolution with zero padding, then ReLU. x (H, W, CI), kernel (CO, CI, 3, 3)."""
    height, width = x.shape[:2]
    padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
    out = np.zeros((height, width, len(bias))) + bias
    for i in range(3):
        for j in range(3):
            out += padded[i : i + height, j : j + width] @ kernel[:, :, i, j].T
    return np.maximum(out, 0)


def max_pool(x):
    """Largest value of each 2x2 cell; an odd last row or column is dropped."""
    height, width, channels = x.shape[0] // 2, x.shape[1] // 2, x.shape[2]
    return x[: 2 * height, : 2 * width].reshape(height, 2, width, 2, channels).max(axis=(1, 3))


def pixel_distance(a, b, head):
    """Weighted squared distance of the unit feature vectors of each pixel; a, b (..., C)."""
    unit_a = a / (np.sqrt((a**2).sum(axis=-1, keepdims=True)) + 1e-10)
    unit_b = b / (np.sqrt((b**2).sum(axis=-1, keepdims=True)) + 1e-10)
    return ((unit_a - unit_b) ** 2) @ head


def lpips(a, b, weights):
    """Distance of two (H, W, 3) images in [0, 1]; weights as pp_cl.lpips_weights.load_weights()
    names them.
    """
    weights = {name: array.astype(np.float64) for name, array in weights.items()}
    x, y = scaled_input(a), scaled_input(b)
    layer, total = 0, 0.0
    for block, convolutions in enumerate(BLOCKS):
        if block:
            x, y = max_pool(x), max_pool(y)
        for _ in range(convolutions):
            kernel, bias = weights[f"kernel{layer}"], weights[f"bias{layer}"]
            x, y = convolve_relu(x, kernel, bias), convolve_relu(y, kernel, bias)
            layer += 1
        total += pixel_distance(x, y, weights[f"head{block}"]).mean()
    return total


def pixel_distance_gradient(a, b, head):
    """Gradient of pixel_distance(a, b, head).sum() by a; 0 at pixels without features."""
    length = np.sqrt((a**2).sum(axis=-1, keepdims=True))
    unit_a = a / (length + 1e-10)
    unit_b = b / (np.sqrt((b**2).sum(axis=-1, keepdims=True)) + 1e-10)
    by_unit = 2 * head * (unit_a - unit_b)
    turned = (by_unit * a).sum(axis=-1, keepdims=True) / np.where(length > 0, length, np.inf)
    return by_unit / (length + 1e-10) - turned * a / (length + 1e-10) ** 2


def lpips_gradient(a, b, weights):
    """Gradient of lpips(a, b, weights) by a, (H, W, 3)."""
    weights = {name: array.astype(np.float64) for name, array in weights.items()}
    inputs, features = [], []  # of each convolution; of each block, of both images
    for image in (a, b):
        x, seen, found, layer = scaled_input(image), [], [], 0
        for block, convolutions in enumerate(BLOCKS):
            x = max_pool(x) if block else x
            for _ in range(convolutions):
                seen.append(x)
                x = convolve_relu(x, weights[f"kernel{layer}"], weights[f"bias{layer}"])
                layer += 1
            found.append(x)
        inputs, features = inputs or seen, [*features, found]

    grad = None
    for block in reversed(range(len(BLOCKS))):
        x, y = (found[block] for found in features)
        here = pixel_distance_gradient(x, y, weights[f"head{block}"]) / (x.shape[0] * x.shape[1])
        grad = here if grad is None else here + maxpool2_gradient(x, grad)
        for _ in range(BLOCKS[block]):
            layer -= 1
            grad_out, kernel = grad * (x > 0), weights[f"kernel{layer}"]
            x = inputs[layer]
            grad = conv_gradients(x, kernel, grad_out)[0]
    return grad * 2 / np.array([0.458, 0.448, 0.450])


def random_weights(rng):
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
