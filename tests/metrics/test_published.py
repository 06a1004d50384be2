"""Published results: for the scene they were measured on, and for no other."""

import numpy as np

from pp_cl.metrics.published import published_row
from pp_cl.scene.camera import Camera
from pp_cl.scene.load import load_scene

LEGO = {"PlenopticPoints": {"psnr": 33.00, "ssim": 0.975, "lpips": 0.026}}


def cameras(focal=1111.111, size=800):
    return [Camera(np.eye(3, 4), focal, focal, size / 2, size / 2, size, size)] * 2


def test_a_row_belongs_to_a_name_and_its_cameras():
    assert published_row("lego", cameras()) == LEGO
    assert published_row("other", cameras()) == {}
    assert published_row("lego", cameras(size=400)) == {}
    assert published_row("lego", cameras(focal=1000.0)) == {}


def test_the_real_scenes(data):
    for folder, expected in (("nerf_synthetic/lego", LEGO), ("ethiopian_head", {})):
        scene = load_scene(data / folder, ("test",))
        stored = [view.stored_camera for view in scene.splits["test"]]
        assert published_row(scene.name, stored) == expected
