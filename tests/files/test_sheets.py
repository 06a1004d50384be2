import numpy as np

from pp_cl.files.image import read_rgba
from pp_cl.files.sheets import GAP, HEADER, contact_sheet, write_comparison


def tile(picture, row, column, height, width):
    y, x = HEADER + row * (HEADER + height + GAP), column * (width + GAP)
    return picture[y : y + height, x : x + width]


def test_predictions_stand_beside_the_truth_and_the_error(tmp_path, rng):
    predictions = rng.uniform(0, 1, (2, 30, 40, 3)).astype(np.float32)
    truths = np.clip(predictions + rng.uniform(-0.1, 0.1, predictions.shape), 0, 1)
    truths[0, :5] = predictions[0, :5]
    truths[1, :5] = 1 - np.round(predictions[1, :5])
    write_comparison(tmp_path / "a.png", predictions, truths)
    picture = read_rgba(tmp_path / "a.png")[..., :3]
    shape = 2 * (HEADER + 30) + GAP, 3 * 40 + 2 * GAP, 3
    assert picture.shape == shape
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


def test_images_stand_row_by_row_under_their_names(rng):
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


def test_what_is_smaller_or_transparent_is_white_there():
    images = [np.full((h, w, 3), i, np.uint8) for i, (w, h) in enumerate(((48, 48), (37, 29)))]
    clear = np.dstack([np.full((24, 40, 3), 90, np.uint8), np.zeros((24, 40, 1), np.uint8)])
    clear[:, :20, 3] = 255
    picture = contact_sheet([*images, clear], list("abc"), columns=2)
    assert picture.shape == (2 * (HEADER + 48) + GAP, 2 * 48 + GAP, 3)
    assert (tile(picture, 0, 1, 48, 48)[:29, :37] == 1).all()
    assert (tile(picture, 0, 1, 48, 48)[29:] == 255).all()
    below = tile(picture, 1, 0, 48, 48)
    assert (below[:24, :20] == 90).all() and (below[:24, 20:] == 255).all()
