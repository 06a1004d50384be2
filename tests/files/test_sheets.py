"""The picture of predictions beside the truth and the error."""

import numpy as np

from pp_cl.files.sheets import GAP, HEADER, comparison, contact_sheet


def tile(picture, row, column, height, width):
    """One image of the picture."""
    y, x = HEADER + row * (HEADER + height + GAP), column * (width + GAP)
    return picture[y : y + height, x : x + width]


def test_tiles_stand_in_their_places(rng):
    predictions = rng.uniform(0, 1, (2, 30, 40, 3)).astype(np.float32)
    truths = np.clip(predictions + rng.uniform(-0.1, 0.1, predictions.shape), 0, 1)
    truths[0, :5] = predictions[0, :5]
    truths[1, :5] = 1 - np.round(predictions[1, :5])
    picture = comparison(list(predictions), list(truths))
    shape = 2 * (HEADER + 30) + GAP, 3 * 40 + 2 * GAP, 3
    assert picture.dtype == np.uint8 and picture.shape == shape
    for row in range(2):
        assert np.abs(tile(picture, row, 0, 30, 40) - predictions[row] * 255).max() <= 0.5 + 1e-4
        assert np.abs(tile(picture, row, 1, 30, 40) - truths[row] * 255).max() <= 0.5 + 1e-4
        error = np.abs(predictions[row] - truths[row]).mean(axis=2)
        expected = 255 * np.clip(1 - 4 * error, 0, 1)
        assert np.abs(tile(picture, row, 2, 30, 40) - expected[..., None]).max() <= 0.5 + 1e-4
    assert (tile(picture, 0, 2, 30, 40)[:5] == 255).all() and (
        tile(picture, 1, 2, 30, 40)[:5] == 0
    ).all()
    assert (picture[:HEADER] < 128).any(), "no captions"


def test_photographs_stand_row_by_row_under_their_names(rng):
    images = [rng.integers(0, 256, (30, 40, 3), np.uint8) for _ in range(5)]
    picture = contact_sheet(images, list("abcde"), columns=3)
    height, width = HEADER + 30 + GAP, 40 + GAP
    assert picture.shape == (2 * height - GAP, 3 * width - GAP, 3)
    for i, image in enumerate(images):
        y, x = i // 3 * height, i % 3 * width
        assert (picture[y + HEADER : y + HEADER + 30, x : x + 40] == image).all()
        assert (picture[y : y + HEADER, x : x + 40] < 128).any(), "no caption"
    assert (picture[height : height + HEADER + 30, 2 * width :] == 255).all()
    assert contact_sheet(images[:1], ["a"]).shape == (HEADER + 30, 40, 3)
