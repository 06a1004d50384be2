"""Photographs made smaller while they are read, so that a large scene fits into memory."""

from collections.abc import Sequence

import numpy as np

# Of a scene's photographs in memory, as RGBA; more than this is reduced while it is read. A fixed
# number, not what happens to be free: the same command gives the same bits on every machine.
KEPT_BYTES = 2**29
ROWS = 16  # of the smaller image at a time: what is summed stays in a cache


def shrink_factor(sizes: Sequence[tuple[int, int]], downscale: int) -> int:
    """How many times to reduce photographs of these (width, height), in pixels, while they are
    read, where a training reduces them `downscale` times: the least divisor of it with which they
    take KEPT_BYTES at most, else all of it.
    """
    divisors = (f for f in range(1, downscale + 1) if downscale % f == 0)
    return next((f for f in divisors if kept_bytes(sizes, f) <= KEPT_BYTES), downscale)


def kept_bytes(sizes: Sequence[tuple[int, int]], factor: int) -> int:
    """Bytes of the images that photographs of these (width, height) become."""
    return sum(4 * (width // factor) * (height // factor) for width, height in sizes)


def shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """(H // factor, W // factor, 4) uint8 straight RGBA of (H, W, 4): means of blocks of
    factor x factor pixels on premultiplied colour, rounded. Rows and columns that fill no block are
    cut off.
    """
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    small = np.empty((height, width, 4), np.uint8)
    for first in range(0, height, ROWS):
        last = min(first + ROWS, height)
        _write_means(image[factor * first : factor * last, : factor * width], small[first:last])
    return small


def _write_means(image, small):
    """shrink() of an image that blocks fill, into `small`."""
    alpha = np.ascontiguousarray(image[..., 3])
    opacity, area = _sums(alpha, small.shape[:2]), image[..., 0].size // small[..., 0].size
    for i in range(3):
        colour = _sums(np.multiply(image[..., i], alpha, dtype=np.uint16), small.shape[:2])
        small[..., i] = (colour + opacity // 2) // np.maximum(opacity, 1)
    small[..., 3] = (opacity + area // 2) // area


def _sums(values, shape):
    """uint32 sums of the blocks of one channel, of which there are `shape`: over rows first, whose
    values lie side by side.
    """
    rows, columns = shape
    values = values.reshape(rows, -1, values.shape[1]).sum(1, dtype=np.uint32)
    return np.add.reduceat(
        values, np.arange(0, values.shape[1], values.shape[1] // columns), axis=1
    )
