from dataclasses import replace

import numpy as np
import pytest

from pp_cl.engine.camera import Camera
from pp_cl.engine.views import MASK_THRESHOLD, View, fitting_downscale
from pp_cl.errors import UserError
from pp_cl.presets import IMAGE_SIZES


@pytest.fixture
def view():
    """A view of 70x50 pixels, all transparent."""
    return View(
        "a.png", Camera(np.eye(3, 4), 60, 60, 35, 25, 70, 50), np.zeros((50, 70, 4), np.uint8)
    )


def test_reduced(view):
    reduced = view.reduced(3)
    camera = reduced.camera
    assert (camera.width, camera.height, camera.fx, camera.cx) == (23, 16, 20, 35 / 3)
    assert reduced.image is view.image and reduced.stored_camera is view.stored_camera
    assert reduced.reduced(2).camera == view.camera.downscaled(2)


@pytest.mark.parametrize("downscale", (0, -1, 4, 1.5, "2", None))
def test_reduced_too_far(view, downscale):
    with pytest.raises(UserError, match=r"--downscale .*from 1 to 3.*70x50 pixels of a\.png"):
        view.reduced(downscale)
    low = View("a.png", view.stored_camera.crop(0, 0, 70, 15), view.image[:15])
    with pytest.raises(UserError, match=r"a\.png: 70x15 pixels"):
        low.reduced(1)


def test_of_another_size(view, rng):
    """Each pixel is the mean by area of what it covers, with premultiplied colours."""
    image = rng.integers(1, 256, (50, 70, 4), dtype=np.uint8)
    ignored = np.zeros((50, 70), bool)
    ignored[49, 0] = True
    smaller = replace(view, image=image, ignored=ignored).of_size(28)  # 2.5 pixels each
    camera = smaller.camera
    assert (camera.width, camera.height, camera.fx, camera.cy) == (28, 20, 24, 10)
    premultiplied = image.astype(np.float64)
    premultiplied[..., :3] *= premultiplied[..., 3:] / 255
    fine = premultiplied.repeat(2, 0).repeat(2, 1).reshape(20, 5, 28, 5, 4).mean((1, 3))
    fine[..., :3] *= 255 / fine[..., 3:]
    np.testing.assert_allclose(smaller.image, fine, atol=0.51)
    assert np.argwhere(smaller.ignored).tolist() == [[19, 0]]
    np.testing.assert_array_equal(replace(view, image=image).of_size(70).image, image)


@pytest.mark.parametrize("downscale", (1, 2, 3))
@pytest.mark.parametrize("margin", (0, 2, 100))
def test_object_bounds_are_the_tightest(view, rng, downscale, margin):
    assert view.reduced(3).object_bounds(5) == (0, 0, 23, 16)  # no pixel is opaque
    for _ in range(5):
        view.image[..., 3] = rng.integers(0, MASK_THRESHOLD + 1, view.image.shape[:2])
        view.image[rng.integers(5, 50, 4), rng.integers(9, 70, 4), 3] = MASK_THRESHOLD + 1
        width, height = 70 // downscale, 50 // downscale
        hit = [
            (x, y)
            for x in range(width)
            for y in range(height)
            if view.image[
                y * downscale : (y + 1) * downscale, x * downscale : (x + 1) * downscale, 3
            ].max()
            > MASK_THRESHOLD
        ]
        x, y = zip(*hit, strict=True)
        expected = (
            max(min(x) - margin, 0),
            max(min(y) - margin, 0),
            min(max(x) + 1 + margin, width),
            min(max(y) + 1 + margin, height),
        )
        assert view.reduced(downscale).object_bounds(margin) == expected


@pytest.mark.parametrize(
    "size, side, expected",
    [
        ((800, 800), 200, 4),
        ((200, 200), 200, 1),
        ((48, 48), 200, 1),  # smaller ones are not enlarged
        ((300, 200), 200, 2),  # 150 is three quarters of 200
        ((4032, 3024), 200, 20),
        ((1000, 40), 200, 2),  # no side below 16 pixels
        ((10, 10), 200, 1),
        ((4032, 3024), IMAGE_SIZES["full"], 3),
        ((4032, 3024), IMAGE_SIZES["paper"], 1),
    ],
)
def test_a_preset_takes_the_whole_number_nearest_to_its_size(size, side, expected):
    assert fitting_downscale(size, side) == expected
