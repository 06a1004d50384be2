"""Float64 twin of cl/scene/target.cl."""

import numpy as np


def target_forward(
    image: np.ndarray, downscale: int, left: int, top: int, *, width: int, height: int
) -> np.ndarray:
    """(height, width, 3): means over white of the downscale x downscale blocks, from (left, top)
    on, of an (H, W, 4) uint8 image.
    """
    colour, alpha = image[..., :3] / 255.0, image[..., 3:] / 255.0
    over_white = colour * alpha + (1 - alpha)
    target = np.ones((height, width, 3))
    for y in range(height):
        for x in range(width):
            row, column = top + downscale * y, left + downscale * x
            rows = [v for v in range(row, row + downscale) if 0 <= v < image.shape[0]]
            columns = [u for u in range(column, column + downscale) if 0 <= u < image.shape[1]]
            if rows and columns:
                target[y, x] = over_white[
                    rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1
                ].mean((0, 1))
    return target
