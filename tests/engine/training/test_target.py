import numpy as np
import pytest

from pp_cl.engine.camera import Camera
from pp_cl.engine.training.target import Target
from pp_cl.engine.views import View
from pp_cl.reference import scene as oracle

TOLERANCE = 5e-7  # a few roundings of a float32 in [0, 1]


def make_view(image, name="image.png"):
    height, width = image.shape[:2]
    pose = np.hstack([np.eye(3), [[0.1], [0.2], [0.3]]])
    return View(name, Camera(pose, 90.0, 95.0, 0.47 * width, 0.55 * height, width, height), image)


def random_view(rng, width, height):
    image = rng.integers(0, 256, (height, width, 4), np.uint8)
    image[..., 3] = rng.choice(
        [0, 255, 7, 130, 254], (height, width), p=[0.33, 0.33, 0.1, 0.14, 0.1]
    )
    return make_view(image)


@pytest.mark.parametrize(
    ("downscale", "jitter"),
    (
        *((4, jitter) for jitter in ((0, 0), (1, 0), (0, 3), (3, 2))),
        *((1, jitter) for jitter in ((0.125, 0), (-0.1, -0.125), (0.4, 0.5))),
    ),
)
def test_camera_sees_what_the_target_shows(dev, downscale, jitter):
    x, y = np.meshgrid(np.arange(80), np.arange(64))
    image = np.stack([3 * x, 4 * y, x + y, np.full_like(x, 255)], -1).astype(np.uint8)
    view, box = make_view(image).reduced(downscale), (2, 2, 12, 9)
    stored = view.stored_camera
    camera = view.crop_camera(box, jitter)
    result = Target(dev).crop(view, box, jitter)[0].get()
    assert (camera.height, camera.width, 3) == result.shape
    for row, column in np.ndindex(result.shape[:2]):
        u = (column + 0.5 - camera.cx) / camera.fx * stored.fx + stored.cx - 0.5
        v = (row + 0.5 - camera.cy) / camera.fy * stored.fy + stored.cy - 0.5
        assert np.abs(result[row, column] * 255 - [3 * u, 4 * v, u + v]).max() < 1e-4
    assert (camera.pose == stored.pose).all()


def test_views_of_other_sizes_and_reductions_one_after_the_other(dev, rng):
    first, second, larger = (random_view(rng, *size) for size in ((40, 40), (40, 40), (50, 60)))
    target = Target(dev)
    for view, k in ((first, 2), (second, 2), (second, 2), (first, 1), (larger, 3), (first, 2)):
        width, height = view.stored_camera.width // k, view.stored_camera.height // k
        expected = oracle.target_forward(view.image, k, 0, 0, width=width, height=height)
        assert np.abs(target.whole(view.reduced(k)) - expected).max() < TOLERANCE
