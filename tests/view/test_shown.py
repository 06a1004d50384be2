"""Quantities as images."""

import io

import numpy as np
import pytest
from PIL import Image
from support.scenes import ring_cameras

from pp_cl.view import shown

CAMERA = ring_cameras(2, 40)[1]


def plane_depth(camera, normal, distance):
    """(H, W) depth of the plane normal . x = distance (world axes) along the camera's axis."""
    return (distance - normal @ camera.eye) / (camera.rays() @ normal)


@pytest.mark.parametrize("tilt", [(0, 0, 0), (0.3, 0, 0), (0, 0.4, 0), (0.2, -0.3, 0.1)])
def test_the_normals_of_a_plane_are_the_planes(tilt):
    normal = -CAMERA.pose[:, 2] + CAMERA.pose[:, :3] @ tilt
    normal /= np.linalg.norm(normal)
    normals = shown.normals_from_depth(plane_depth(CAMERA, normal, 0.1), CAMERA)
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=1e-9)


def test_normals_stay_sharp_at_an_edge_and_end_where_depth_does():
    near, far = (plane_depth(CAMERA, -CAMERA.pose[:, 2], distance) for distance in (0.5, -0.5))
    depth = np.where(np.arange(40) < 20, near, far)
    depth[30:] = np.inf
    normals = shown.normals_from_depth(depth, CAMERA)
    expected = np.broadcast_to(-CAMERA.pose[:, 2], (30, 40, 3))
    np.testing.assert_allclose(normals[:30], expected, atol=1e-9)
    assert np.isnan(normals[30:]).all()
    image = shown.normal_colours(normals)
    assert (image[30:] == np.rint(255 * shown.DARK)).all()


def test_a_lone_pixel_has_no_normal():
    depth = np.full((40, 40), np.inf)
    depth[3, 4] = 2
    assert np.isnan(shown.normals_from_depth(depth, CAMERA)).all()


def test_a_colour_scale_goes_from_violet_to_yellow():
    values = np.array([[0.0, 5.0, 10.0, np.inf]])
    image = shown.colour_scale(values, 0, 10, np.isfinite(values))
    np.testing.assert_array_equal(
        image[0], [(0x44, 1, 0x54), (0x21, 0x91, 0x8C), (0xFD, 0xE7, 0x25), (23, 24, 27)]
    )
    assert shown.colour_scale(np.zeros((2, 2)), 0, 0, np.ones((2, 2), bool)).any()


def test_exposure_doubles_the_light():
    image = np.array([[[0, 60, 188]]], np.uint8)
    np.testing.assert_array_equal(shown.exposed(image, 0), image)
    bright = shown.exposed(image, 1)[0, 0]
    light = ((bright / 255 + 0.055) / 1.055) ** 2.4
    before = ((image[0, 0] / 255 + 0.055) / 1.055) ** 2.4
    assert bright[0] == 0
    np.testing.assert_allclose(light[1:], 2 * before[1:], rtol=0.02)
    assert (shown.exposed(image, 6)[0, 0, 1:] == 255).all()


def test_an_error_shows_four_times():
    image = np.zeros((1, 2, 3), np.float32)
    truth = np.array([[[0, 0.1, 0.5], [0, 0, 0]]], np.float32)
    np.testing.assert_array_equal(shown.error_image(image, truth), [[[0, 102, 255], [0, 0, 0]]])


def test_a_lossless_image_comes_back():
    image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    back = np.array(Image.open(io.BytesIO(shown.encoded(image, lossless=True))))
    np.testing.assert_array_equal(back, image)
    assert Image.open(io.BytesIO(shown.encoded(image, lossless=False))).format == "JPEG"
