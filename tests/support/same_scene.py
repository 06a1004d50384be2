"""A small scene with known cameras, and a check that a folder holds it."""

import numpy as np
from support.scenes import ring_cameras

from pp_cl.engine.camera import Camera
from pp_cl.engine.views import View
from pp_cl.scene.load import load_scene
from pp_cl.scene.readers.common import SPLITS, hold_out


def views(count=11, size=(30, 22), *, centred=False, alike=False):
    """Views with random pixels. centred: principal points in the middle, fx = fy; alike: all have
    one lens.
    """
    rng = np.random.default_rng(5)
    made = []
    for i, camera in enumerate(ring_cameras(count, size[0])):
        change, (width, height) = 0 if alike else i, size
        lens = (camera.fx + change, 1.02 * camera.fx, width / 2 + 0.7 - 0.1 * change, height / 2)
        if centred:
            lens = (camera.fx, camera.fx, width / 2, height / 2)
        image = rng.integers(0, 256, (size[1], size[0], 4), np.uint8)
        made.append(View(f"{i}.png", Camera(camera.pose, *lens, *size), image))
    return made


def held_out(all_views):
    """{split: views} as formats without splits have them."""
    return {split: hold_out(all_views, split) for split in SPLITS}


def same(folder, splits, atol=1e-6):
    """Assert that the folder holds these views: cameras, images, masks."""
    read = load_scene(folder, tuple(splits)).splits
    for split, expected in splits.items():
        assert len(read[split]) == len(expected)
        for got, view in zip(read[split], expected, strict=True):
            a, b = got.stored_camera, view.stored_camera
            np.testing.assert_allclose(a.pose, b.pose, rtol=0, atol=atol)
            np.testing.assert_allclose(
                [a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy], rtol=1e-7, atol=atol
            )
            assert (a.width, a.height) == (b.width, b.height)
            np.testing.assert_array_equal(got.image, view.image)
