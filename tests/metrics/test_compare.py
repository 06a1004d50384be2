import numpy as np
import pytest
from PIL import Image

from pp_cl.errors import UserError
from pp_cl.files.image import write_png
from pp_cl.metrics.compare import compare, read_over_white
from pp_cl.metrics.psnr_ssim import Metrics


@pytest.fixture
def folders(rng, tmp_path):
    for folder in ("pred", "truth"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "notes.txt").write_text("no image")
        for name in ("b.png", "a.png"):
            write_png(tmp_path / folder / name, rng.integers(0, 256, (12, 14, 3), np.uint8))
    return tmp_path / "pred", tmp_path / "truth"


def test_two_images(folders):
    pred, truth = folders[0] / "a.png", folders[1] / "b.png"
    result = compare(pred, truth, ("psnr", "ssim"))
    expected = Metrics(None, ("psnr", "ssim"))(read_over_white(pred), read_over_white(truth))
    assert result == {"mean": expected, "per_image": [{"name": "a.png", **expected}]}


def test_every_image_of_a_folder_is_compared_or_refused(folders):
    for folder in folders:
        Image.open(folder / "a.png").save(folder / "c.webp", lossless=True)
        Image.open(folder / "a.png").save(folder / "d.JPG")
        (folder / "._a.png").write_bytes(b"resource fork")
    result = compare(*folders, ("psnr",))
    assert [row["name"] for row in result["per_image"]] == ["a.png", "b.png", "c.webp", "d.JPG"]
    assert result["per_image"][2]["psnr"] == result["per_image"][0]["psnr"]
    Image.open(folders[1] / "a.png").save(folders[1] / "e.gif")
    with pytest.raises(UserError, match="truth/e.gif: "):
        compare(*folders, ("psnr",))


def test_transparent_images_lie_over_white(tmp_path):
    rgba = np.array([[[0, 0, 0, 0], [255, 0, 0, 255], [0, 0, 200, 51]]], np.uint8)
    write_png(tmp_path / "rgba.png", rgba)
    expected = [[[255, 255, 255], [255, 0, 0], [204, 204, 244]]]
    np.testing.assert_allclose(read_over_white(tmp_path / "rgba.png") * 255, expected, atol=1e-9)


def test_bad_input_names_the_file(folders, tmp_path):
    pred, truth = folders

    def refuse(a, b, match, metrics=("psnr", "ssim")):
        with pytest.raises(UserError, match=match):
            compare(a, b, metrics)

    refuse(pred, truth / "a.png", "truth/a.png: not a folder")
    refuse(pred / "c.png", truth / "a.png", "pred/c.png: ")
    refuse(pred, tmp_path / "y", "/y: not a folder")
    (tmp_path / "empty").mkdir()
    refuse(tmp_path / "empty", tmp_path / "empty", "empty: no images")
    refuse(pred, tmp_path / "empty", "empty/a.png: missing")

    write_png(pred / "a.png", np.zeros((12, 13, 3), np.uint8))
    refuse(pred, truth, "pred/a.png: 13x12 pixels, .*truth/a.png has 14x12")
    for folder in folders:
        write_png(folder / "a.png", np.zeros((9, 9, 3), np.uint8))
    refuse(pred, truth, "pred/a.png: 9x9 pixels, but SSIM needs 11x11")
    (pred / "b.png").unlink()
    refuse(pred, truth, "pred/b.png: missing")
