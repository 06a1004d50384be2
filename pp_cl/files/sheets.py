"""Contact sheets: one image with many images, such as predictions next to the truth."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from pp_cl.files.image import to_8bit, write_png

ERROR_SCALE = 4
GAP = 2  # pixels between the images
HEADER = 14  # pixels for the captions
CAPTIONS = ("prediction", "truth", f"error x{ERROR_SCALE}")
LINE, INK = (200, 200, 200), (60, 60, 60)


def contact_sheet(
    images: Sequence[np.ndarray], captions: Sequence[str], columns: int = 4
) -> np.ndarray:
    """(H, W, 3) uint8 image that shows uint8 images, (H, W, 3) or (H, W, 4), row by row below their
    captions, over white, in cells of the largest image's size.
    """
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    height += HEADER
    size = columns * (width + GAP) - GAP, rows * (height + GAP) - GAP
    sheet = Image.new("RGB", size, LINE)
    draw = ImageDraw.Draw(sheet)
    for cell in range(rows * columns):
        x, y = cell % columns * (width + GAP), cell // columns * (height + GAP)
        sheet.paste((255, 255, 255), (x, y, x + width, y + height))
        if cell < len(images):
            image = Image.fromarray(images[cell])
            sheet.paste(image, (x, y + HEADER), image if image.mode == "RGBA" else None)
            draw.text((x + 3, y + 1), captions[cell], fill=INK)
    return np.array(sheet)


def write_comparison(
    path: Path, predictions: Sequence[np.ndarray], truths: Sequence[np.ndarray]
) -> None:
    """Write a PNG file that shows float (H, W, 3) images in [0, 1]: for each view, a row of
    prediction, truth and error (the absolute difference times ERROR_SCALE, dark on white).
    """
    images: list[np.ndarray] = []
    for prediction, truth in zip(predictions, truths, strict=True):
        error = np.abs(np.asarray(prediction, np.float64) - truth).mean(axis=2, keepdims=True)
        shown = np.repeat(1 - ERROR_SCALE * error, 3, axis=2)
        images += map(to_8bit, (prediction, truth, shown))
    write_png(path, contact_sheet(images, CAPTIONS * len(predictions), len(CAPTIONS)))
