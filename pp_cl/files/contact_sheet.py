"""Pictures of many images: how well views are predicted, and what photographs there are."""

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
    """uint8 picture of equally large float (H, W, 3) images in [0, 1]: a row of prediction, truth
    and error for each view.

    The error is the absolute difference, mean of the channels, ERROR_GAIN times; white is none, as
    around the object.
    """
    rows = [np.stack([p, t, _error(p, t)]) for p, t in zip(predictions, truths, strict=True)]
    table = np.pad(_table(to_8bit(rows)), ((HEADER, 0), (0, 0), (0, 0)), constant_values=255)
    width = predictions[0].shape[1] + GAP
    return _captioned(table, [(column * width, 0) for column in range(3)], CAPTIONS)


def contact_sheet(
    images: Sequence[np.ndarray], captions: Sequence[str], columns: int = 4
) -> np.ndarray:
    """uint8 picture of equally large uint8 (H, W, 3) images, row by row, a caption above each."""
    height, width = images[0].shape[0] + HEADER + GAP, images[0].shape[1] + GAP
    columns = min(columns, len(images))
    tiles = np.pad(np.stack(images), ((0, 0), (HEADER, 0), (0, 0), (0, 0)), constant_values=255)
    tiles = np.pad(
        tiles, ((0, -len(images) % columns), (0, 0), (0, 0), (0, 0)), constant_values=255
    )
    table = _table(tiles.reshape(-1, columns, *tiles.shape[1:]))
    places = [(i % columns * width, i // columns * height) for i in range(len(images))]
    return _captioned(table, places, captions)


def _table(tiles):
    """Picture of (rows, columns, H, W, 3) uint8 tiles with lines between them."""
    tiles = np.pad(tiles, ((0, 0), (0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=LINE)
    rows, columns, height, width, _ = tiles.shape
    table = tiles.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, 3)
    return table[:-GAP, :-GAP]


def _captioned(table, places, captions):
    """The picture with captions whose strips begin at the places, (x, y)."""
    picture = Image.fromarray(table)
    draw = ImageDraw.Draw(picture)
    for (x, y), caption in zip(places, captions, strict=True):
        draw.text((x + 3, y + 1), caption, fill=INK)
    return np.array(picture)


def _error(prediction, truth):
    error = np.abs(np.asarray(prediction, np.float64) - truth).mean(axis=2, keepdims=True)
    return np.repeat(1 - ERROR_GAIN * error, 3, axis=2)


def write_comparison(
    path: Path, predictions: Sequence[np.ndarray], truths: Sequence[np.ndarray]
) -> None:
    """Write comparison(...) as a PNG file."""
    write_png(path, comparison(predictions, truths))
