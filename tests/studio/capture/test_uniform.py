import numpy as np
import pytest
from PIL import Image

from pp_cl.files.image import read_mask

pytest.importorskip("cv2")

from pp_studio.capture.masks import write_inside
from pp_studio.capture.uniform import is_uniform, uniform_mask

SIDE = 160
Y, X = (np.indices((SIDE, SIDE)) + 0.5) / SIDE - 0.5
BALL = np.hypot(X, Y) < 0.3
WHITE = np.full((SIDE, SIDE), 255.0)
# light from a window at the left, and a lens whose corners are a quarter darker
GRADED = 240 * (1 - 0.1 * X) * (1 - 0.5 * (X * X + Y * Y))
PLANKS = 128 + 30 * np.sin(40 * X) * np.cos(9 * Y)


def image(behind, noise=0.0, ball=(150, 60, 40)):
    """(H, W, 3) uint8: the ball before a wall of given grey levels."""
    colours = np.where(BALL[..., None], ball, behind[..., None])
    noise = np.random.default_rng(0).normal(0, noise, colours.shape) if noise else 0
    return np.uint8(np.clip(colours + noise + 0.5, 0, 255))


@pytest.mark.parametrize("noise", [0, 3])
@pytest.mark.parametrize("behind", [WHITE, 0 * WHITE, 0.8 * WHITE, GRADED])
def test_the_mask_of_a_uniform_background(behind, noise):
    shown = image(behind, noise)
    assert is_uniform(shown)
    mask = uniform_mask(shown, "") > 127
    assert (mask & BALL).sum() / (mask | BALL).sum() > 0.98


def test_a_dark_shade_of_white_is_told_from_white():
    """A white thing lit from one side has such shades; little noise allows a narrow margin."""
    mask = uniform_mask(image(WHITE, ball=(236, 236, 236)), "") > 127
    assert (mask == BALL).mean() > 0.99


@pytest.mark.parametrize("behind", [PLANKS, np.where(X < 0, 60.0, 200.0)])
def test_texture_is_not_uniform(behind):
    assert not is_uniform(image(behind))


def test_an_object_that_reaches_the_border_leaves_no_mask():
    wide = np.where(abs(Y) < 0.3, 90.0, WHITE)
    assert not is_uniform(image(wide)) and uniform_mask(image(wide), "") is None


@pytest.mark.parametrize("is_uniform", [False, True])
def test_all_images_have_a_mask_where_some_have_alpha(tmp_path, is_uniform):
    """Features are looked for within these masks; images without alpha lose no features."""
    shown = image(WHITE)
    Image.fromarray(shown).save(tmp_path / "a.jpg")
    Image.fromarray(np.dstack([shown, np.uint8(255 * (Y < 0))])).save(tmp_path / "b.png")
    write_inside(tmp_path, ["a.jpg", "b.png"], tmp_path / "inside", is_uniform)
    jpeg_mask, png_mask = (
        read_mask(tmp_path / "inside" / f"{name}.png") for name in ("a.jpg", "b.png")
    )
    np.testing.assert_array_equal(png_mask > 127, Y < 0)
    assert ((jpeg_mask > 127) == BALL).mean() > 0.98 if is_uniform else jpeg_mask.min() == 255


def test_no_image_has_a_mask_where_none_tells_the_object(tmp_path):
    Image.fromarray(image(PLANKS)).save(tmp_path / "a.png")
    write_inside(tmp_path, ["a.png"], tmp_path / "inside", False)
    assert not any((tmp_path / "inside").iterdir())
