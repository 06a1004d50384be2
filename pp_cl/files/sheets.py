"""Contact sheets: many images in one picture, predictions beside the truth or photographs of a
scene.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from pp_cl.files.image import to_8bit, write_png

ERROR_GAIN = 4
GAP = 2  # pixels between the images
HEADER = 14  # pixels for the captions
CAPTIONS = ("prediction", "truth", f"error x{ERROR_GAIN}")
LINE, INK = 200, (60, 60, 60)


def comparison(predictions: Sequence[np.ndarray], truths: Sequence[np.ndarray]) -> np.ndarray:
    """uint8 picture of float (H, W, 3) images in [0, 1]: a row of prediction, truth and error for
    each view, whose sizes may differ.

    The error is the absolute difference, mean of the channels, ERROR_GAIN times; white is none, as
    around the object.
    """
    pairs = zip(predictions, truths, strict=True)
    images = [to_8bit(image) for p, t in pairs for image in (p, t, _error(p, t))]
    return contact_sheet(images, CAPTIONS * len(predictions), len(CAPTIONS))


def contact_sheet(
    images: Sequence[np.ndarray], captions: Sequence[str], columns: int = 4
) -> np.ndarray:
    """tiles(images, columns) with a caption above each image, and no more columns than images."""
    columns = min(columns, len(images))
    headed = [np.pad(i, ((HEADER, 0), (0, 0), (0, 0)), constant_values=255) for i in images]
    height, width = (side + GAP for side in _cell(headed))
    picture = Image.fromarray(tiles(headed, columns))
    draw = ImageDraw.Draw(picture)
    for i, caption in enumerate(captions):
        draw.text((i % columns * width + 3, i // columns * height + 1), caption, fill=INK)
    return np.array(picture)


def tiles(images: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """uint8 picture of uint8 images, (H, W, 3) or (H, W, 4), row by row, each in a cell as large as
    the largest; what is transparent, or beside a smaller image, shows white.
    """
    height, width = _cell(images)
    rows = -(-len(images) // columns)
    table = np.full((rows, height + GAP, columns, width + GAP, 3), LINE, np.uint8)
    table[:, :height, :, :width] = 255
    for i, image in enumerate(images):
        y, x = image.shape[:2]
        table[i // columns, :y, i % columns, :x] = _over_white(image)
    return table.reshape(rows * (height + GAP), -1, 3)[:-GAP, :-GAP]


def _cell(images):
    """(height, width) of the largest."""
    return tuple(max(image.shape[axis] for image in images) for axis in (0, 1))


def _over_white(image):
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:] / 255
    return to_8bit(image[..., :3] / 255 * alpha + 1 - alpha)


def _error(prediction, truth):
    error = np.abs(np.asarray(prediction, np.float64) - truth).mean(axis=2, keepdims=True)
    return np.repeat(1 - ERROR_GAIN * error, 3, axis=2)


def write_comparison(
    path: Path, predictions: Sequence[np.ndarray], truths: Sequence[np.ndarray]
) -> None:
    """Write comparison(...) as a PNG file."""
    write_png(path, comparison(predictions, truths))
