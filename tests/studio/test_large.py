from dataclasses import replace

import numpy as np
import pytest

from pp_cl.run import load
from pp_studio.large import parts, render_large


@pytest.fixture
def run(runs, scene, tmp_path, dev):
    return load(device=dev, folder=runs.trained(tmp_path / "run", scene, train__iterations=40))


def test_it_is_woven_of_images_at_the_scale_of_the_training(run):
    camera = run.cameras("test")[0]
    assert parts(run, camera) == 1
    large = camera.resized(4 * camera.width - 3, 4 * camera.height - 5)  # no whole number of blocks
    calls = []
    woven = render_large(run, large, on_part=lambda: calls.append(1))
    assert len(calls) == 16 == parts(run, large) ** 2
    assert woven.colour.shape == (large.height, large.width, 3)
    assert woven.alpha.shape == woven.depth.shape == woven.median_depth.shape
    small = replace(
        large,
        fx=large.fx / 4,
        fy=large.fy / 4,
        cx=large.cx / 4,
        cy=large.cy / 4,
        width=24,
        height=24,
    )
    # the pixel (x, y) of 4 x 4 is (x + 0.5) / 4 - 0.5 of the small image's pixels from its middle
    part = run.render(small.shifted(1.5 / 4 - 0.5, 3.5 / 4 - 0.5))
    for name in ("colour", "alpha", "depth"):
        rows, columns = getattr(woven, name)[3::4, 1::4].shape[:2]
        expected = getattr(part, name)[:rows, :columns]
        assert np.array_equal(getattr(woven, name)[3::4, 1::4], expected)


def test_a_camera_that_is_near_is_a_large_one(run):
    camera, centre = run.cameras("test")[0], run.ball[0]
    large = camera.resized(128, 128)
    pose = camera.pose.copy()
    pose[:, 3] = centre + (camera.eye - centre) / 2
    assert parts(run, replace(camera.resized(64, 64), pose=pose)) == parts(run, large) == 4
    assert parts(run, camera.resized(20, 20)) == 1
