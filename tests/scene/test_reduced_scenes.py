from dataclasses import replace

import numpy as np
import pytest
from support.scenes import write_ball_scene

from pp_cl.config import preset
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.scene.identity import difference, identity
from pp_cl.scene.image_file import MOST_IMAGE_BYTES, image_bytes, shrink, shrink_factor
from pp_cl.scene.listing import scene_frames
from pp_cl.scene.load import load_scene, open_scene

PHONE = (4000, 3000)


@pytest.mark.parametrize("factor", (1, 2, 3, 7, 64))
def test_blocks_become_their_mean(rng, factor):
    image = rng.integers(0, 256, (150, 131, 4), dtype=np.uint8)
    image[:70, :, 3] = 255
    image[100:, :70, 3] = 0
    small = shrink(image, factor)
    assert small.shape == (150 // factor, 131 // factor, 4) and small.dtype == np.uint8
    for y, x in np.ndindex(small.shape[:2]):
        block = image[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor].astype(float)
        alpha = block[..., 3]
        colour = (block[..., :3] * alpha[..., None]).sum((0, 1)) / max(alpha.sum(), 1)
        expected = image[y, x] if factor == 1 else [*colour, alpha.mean()]
        assert np.abs(small[y, x] - expected).max() <= 0.5 + 1e-9


@pytest.mark.parametrize(
    "count, downscale, factor",
    [
        (11, 8, 1),  # 5.28e8 bytes: just below 2^29
        (12, 8, 2),
        (150, 8, 4),
        (300, 8, 8),  # reduced by 4: 9e8
        (300, 1, 1),
        (300, 7, 7),
        (170, 12, 4),  # reduced by 3: 9e8
        (5000, 8, 8),  # still too many, so they get the training's reduction
    ],
)
def test_the_least_reduction_that_fits(count, downscale, factor):
    sizes = [PHONE] * count
    assert shrink_factor(sizes, downscale) == factor
    smaller = [f for f in range(1, factor) if downscale % f == 0]
    assert all(image_bytes(sizes, f) > MOST_IMAGE_BYTES for f in smaller)


@pytest.fixture
def scene(tmp_path):
    return write_ball_scene(tmp_path / "ball", size=98)


@pytest.mark.parametrize("downscale, stored, size", [(1.6, 61, 61), (2.8, 70, 35)])
def test_what_no_whole_number_gives_is_resampled_once(scene, downscale, stored, size):
    """It keeps as many stored pixels for each of its own as the whole number below would."""
    (whole, *_), (view, *_) = (
        load_scene(scene, downscale=factor).splits["train"] for factor in (1, downscale)
    )
    assert view.image.shape == (stored, stored, 4) and view.camera.width == size
    names, expected = ("fx", "cy", "width"), whole.file_camera.downscaled(downscale)
    assert [getattr(view.camera, n) for n in names] == [getattr(expected, n) for n in names]
    assert view.file_downscale == pytest.approx(downscale, rel=0.01)
    assert view.file_camera.width == 98 and view.digest == whole.digest
    assert view.image[..., 3].mean() == pytest.approx(whole.image[..., 3].mean(), rel=0.01)


def large(monkeypatch, most=8 * 4 * 50 * 50):
    """Count scenes as large from `most` bytes on: eight images of 98 pixels are then halved."""
    monkeypatch.setattr("pp_cl.scene.image_file.MOST_IMAGE_BYTES", most)


def opened(dev, scene, downscale):
    config = preset("tiny")
    config.scene = replace(config.scene, path=scene, downscale=downscale)
    return open_scene(dev, config, ("train",)).splits["train"]


def same(one, other):
    return (one.packed((1, 2)) == other.packed((1, 2))).all() and one.fx == other.fx


def test_a_large_scene_is_kept_reduced_and_stays_itself(dev, scene, monkeypatch):
    whole = opened(dev, scene, 4)
    large(monkeypatch)
    views = opened(dev, scene, 4)
    for view, before in zip(views, whole, strict=True):
        pixels = read_rgba(f"{scene}/{view.name}")
        assert (view.shrunk, view.downscale, view.file_downscale) == (2, 2, 4)
        np.testing.assert_array_equal(view.image, shrink(pixels, 2))
        assert same(view.camera, before.camera)  # exact, as a division by 2
        assert same(view.file_camera, before.stored_camera)
        assert before.file_camera is before.stored_camera
    header = identity(whole)
    assert identity(views) == header
    assert difference(header, scene_frames(scene), views) == ""
    moved = views[0].moved((1, 2, 3))
    assert same(moved.file_camera, whole[0].moved((1, 2, 3)).stored_camera)


def test_pixels_stay_as_stored_where_nothing_is_reduced(dev, scene, monkeypatch):
    large(monkeypatch, most=1)
    for view in (opened(dev, scene, 1)[0], load_scene(scene).splits["train"][0]):
        np.testing.assert_array_equal(view.image, read_rgba(f"{scene}/{view.name}"))
        assert view.shrunk == 1


def test_too_far_is_refused_before_an_image_is_read(dev, scene, monkeypatch):
    large(monkeypatch)
    monkeypatch.setattr("pp_cl.scene.image_file.read_rgba", None)
    with pytest.raises(UserError, match=r"--downscale 7: .* from 1 to 6, .*98x98"):
        opened(dev, scene, 7)


def test_a_reduced_image_is_reduced_further_in_words_of_its_file(dev, scene, monkeypatch):
    large(monkeypatch)
    view = opened(dev, scene, 4)[0]
    assert view.reduced(3).file_downscale == 6
    with pytest.raises(UserError, match=r"--downscale 8: .* from 1 to 6, .*98x98"):
        view.reduced(4)
