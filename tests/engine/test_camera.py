from dataclasses import replace

import numpy as np
import pytest

from pp_cl.engine.camera import Camera, look_at


def make_camera(rng, width=40, height=30):
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    return Camera(np.c_[rotation, rng.normal(size=3)], 50.0, 55.0, 19.0, 16.5, width, height)


def project(camera, points):
    """(N, 2) float64 pixel coordinates (pixel centres at +0.5)."""
    c = (points - camera.eye) @ camera.pose[:, :3]
    return np.stack(
        [camera.fx * c[:, 0] / c[:, 2] + camera.cx, camera.fy * c[:, 1] / c[:, 2] + camera.cy], -1
    )


def points_in_front(camera, rng, n=20):
    return camera.eye + (rng.uniform([-1, -1, 2], [1, 1, 4], (n, 3))) @ camera.pose[:, :3].T


def test_packed_layout(rng):
    camera = make_camera(rng)
    packed = replace(camera, samples=3.0).packed((1, 5))
    assert packed.shape == (21,) and packed.dtype == np.float32
    point = points_in_front(camera, rng, 1)[0]
    in_camera = packed[:9].reshape(3, 3) @ (point - packed[9:12])
    np.testing.assert_allclose(in_camera, (point - camera.eye) @ camera.pose[:, :3], rtol=1e-5)
    np.testing.assert_allclose(packed[12:], [50, 55, 19, 16.5, 1, 5, 40, 30, 3])


def test_places_in_the_image_and_rays_through_pixels(rng):
    camera = make_camera(rng)
    points = points_in_front(camera, rng)
    *pixels, depth = camera.project(points)
    np.testing.assert_allclose(np.transpose(pixels), project(camera, points))
    np.testing.assert_allclose(depth, (points - camera.eye) @ camera.pose[:, 2])
    x, y, depth = camera.project(camera.eye + 2.5 * camera.rays())
    np.testing.assert_allclose([x[3, 7], y[3, 7], depth[3, 7]], [7.5, 3.5, 2.5])


def test_look_at_centres_the_target_and_points_up(rng):
    for eye, target, up in rng.normal(size=(20, 3, 3)):
        camera = Camera.look_at(eye, target, up, fx=50.0, fy=55.0, width=40, height=30)
        assert np.array_equal(camera.pose, look_at(eye, target, up))
        rotation = camera.pose[:, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0 and (target - eye) @ rotation[:, 2] > 0
        np.testing.assert_allclose(project(camera, target[None]), [[20, 15]], atol=1e-9)
        above = project(camera, (target + 1e-3 * up)[None])[0]
        assert above[1] < 15 and above[0] == pytest.approx(20, abs=1e-6)


def test_crop_shift_and_downscale_move_pixels_as_they_say(rng):
    camera = make_camera(rng)
    points = points_in_front(camera, rng)
    uv = project(camera, points)
    np.testing.assert_allclose(project(camera.crop(3, -2, 10, 10), points), uv - [3, -2])
    np.testing.assert_allclose(project(camera.shifted(0.25, 0.75), points), uv - [0.25, 0.75])
    np.testing.assert_allclose(project(camera.downscaled(4), points), uv / 4)
    assert (camera.downscaled(4).width, camera.downscaled(4).height) == (10, 7)


@pytest.mark.parametrize("margin", [0, 3, 4])
@pytest.mark.parametrize("width, height", [(40, 30), (1, 1), (33, 31), (4, 8)])
def test_padding_keeps_every_pixel(rng, width, height, margin):
    camera = make_camera(rng, width, height)
    padded, left, top = camera.padded(4, margin)
    assert padded.width % 4 == padded.height % 4 == 0
    more = [padded.width - width - 2 * margin, padded.height - height - 2 * margin]
    assert (left, top) == (margin + more[0] // 2, margin + more[1] // 2)
    assert min(more) >= 0 and max(more) < 4
    points = points_in_front(camera, rng)
    np.testing.assert_allclose(project(padded, points), project(camera, points) + [left, top])


def test_resized_shows_as_much_across():
    camera = Camera(np.eye(3, 4), 50, 60, 33, 20, 64, 48)
    wide = camera.resized(128, 48)
    assert (wide.fx, wide.fy, wide.cx, wide.cy) == (100, 120, 66, 16)
    same = camera.resized(64, 48)
    assert (same.fx, same.fy, same.cx, same.cy) == (50, 60, 33, 20)
    angle = camera.with_angle(np.pi / 2)
    assert (angle.fx, angle.fy) == pytest.approx((32, 38.4))
