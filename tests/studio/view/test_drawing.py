"""What a run shows to a camera."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import ring_cameras

from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.run import load_run
from pp_studio.view.drawing import (
    DARK,
    SHOWN,
    colour_scale,
    draw,
    most_opaque,
    nearest_view,
    normals_from_depth,
)

CAMERA = ring_cameras(3, 48)[2]


@pytest.fixture
def run(dev, trained):
    return load_run(dev, trained)


@pytest.fixture
def views(run):
    return run.scene("train").splits["train"]


def test_a_image_is_what_the_run_renders(run):
    image, line = draw(run, [], CAMERA)
    np.testing.assert_array_equal(image, to_8bit(run.render(CAMERA).colour))
    assert line == ""


def test_every_quantity_is_another_image(run, views):
    images = {show: draw(run, views, CAMERA, show) for show in SHOWN}
    assert len({image.tobytes() for image, _ in images.values()}) == len(SHOWN)
    assert {image.shape for image, _ in images.values()} == {(48, 48, 3), (24, 24, 3)}
    low, high = (float(word) for word in images["depth"][1].split(" to "))
    assert 0 < low < 4 < high


@pytest.mark.parametrize("change", [{"early_stop": 0.5}, {"share": 0.3}, {"exposure": -1}])
def test_every_slider_changes_the_image_and_spoils_nothing(run, change):
    before, changed, after = (draw(run, [], CAMERA, **c)[0] for c in ({}, change, {}))
    assert np.abs(changed.astype(int) - before).max() > 3
    np.testing.assert_array_equal(after, before)


def test_the_error_is_that_of_the_nearest_view_from_its_own_camera(run, views):
    view = views[5]
    near = replace(view.camera, pose=view.camera.pose + 1e-3 * np.eye(3, 4, 3))
    error, line = draw(run, views, near, "error")
    photo, name = draw(run, views, near, "photograph")
    assert line == f"{view.name}, error x4" and name == view.name
    rendering = to_8bit(run.render(view.camera).colour).astype(int)
    expected = np.minimum(4 * np.abs(rendering - photo), 255)
    assert np.abs(error - expected).max() <= 5  # both are rounded, four times
    assert photo.min() < 250 and error.max() > 5
    with pytest.raises(UserError, match="photographs"):
        draw(run, [], near, "error")


def test_fragments_are_those_of_the_pairs(run):
    camera = replace(CAMERA, width=45, height=43)  # is padded
    image, line = draw(run, [], camera, "fragments")
    view = run.renderer.forward(camera, run.gamma, until="weights")
    fragments = view.cropped(np.diff(view.pairs.pixel_offset.get().astype(int)).reshape(view.size))
    assert line == f"0 to {fragments.max()} fragments" and fragments.max() > 1
    np.testing.assert_array_equal(image, colour_scale(fragments, 0, fragments.max(), fragments > 0))


def test_the_most_opaque_points_are_kept(run):
    opacity, ids = run.model.cloud.opacity.get(), run.model.cloud.ids.get()
    fewer = most_opaque(run, 0.25).model
    left = fewer.cloud.opacity.get()
    assert len(left) == round(0.25 * len(opacity))
    assert left.min() >= np.sort(opacity)[-len(left)]
    rows = np.searchsorted(ids, fewer.cloud.ids.get())
    for whole, part in zip(run.model.cloud.sh, fewer.cloud.sh, strict=True):
        np.testing.assert_array_equal(part.get(), whole.get()[rows])
    np.testing.assert_array_equal(run.model.cloud.opacity.get(), opacity)
    assert most_opaque(run, 1e-9).model.cloud.count == 1


def test_the_nearest_view_counts_place_and_direction():
    cameras, centre = ring_cameras(6, 48), np.zeros(3)
    assert [nearest_view(cameras, camera, centre) for camera in cameras] == list(range(6))
    away = replace(cameras[2], pose=cameras[2].pose * [-1, 1, -1, 1])  # looks outwards
    assert nearest_view([away, cameras[2]], cameras[2], centre) == 1


def plane_depth(normal, distance):
    """(H, W) depth of the plane normal . x = distance (world axes) along the camera's axis."""
    return (distance - normal @ CAMERA.eye) / (CAMERA.rays() @ normal)


@pytest.mark.parametrize("tilt", [(0, 0, 0), (0.3, 0, 0), (0, 0.4, 0), (0.2, -0.3, 0.1)])
def test_the_normals_of_a_plane_are_the_planes(tilt):
    normal = -CAMERA.pose[:, 2] + CAMERA.pose[:, :3] @ tilt
    normal /= np.linalg.norm(normal)
    normals = normals_from_depth(plane_depth(normal, 0.1), CAMERA)
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=1e-9)


def test_normals_stay_sharp_at_an_edge_and_end_where_depth_does():
    near, far = (plane_depth(-CAMERA.pose[:, 2], distance) for distance in (0.5, -0.5))
    depth = np.where(np.arange(48) < 20, near, far)
    depth[30:] = np.nan
    normals = normals_from_depth(depth, CAMERA)
    expected = np.broadcast_to(-CAMERA.pose[:, 2], (30, 48, 3))
    np.testing.assert_allclose(normals[:30], expected, atol=1e-9)
    assert np.isnan(normals[30:]).all()
    lone = np.full((48, 48), np.nan)
    lone[3, 4] = 2
    assert np.isnan(normals_from_depth(lone, CAMERA)).all()


def test_a_colour_scale_goes_from_violet_to_yellow():
    values = np.array([[0.0, 5.0, 10.0, np.inf]])
    image = colour_scale(values, 0, 10, np.isfinite(values))
    dark = np.rint(255 * DARK)
    np.testing.assert_array_equal(
        image[0], [(0x44, 1, 0x54), (0x21, 0x91, 0x8C), (0xFD, 0xE7, 0x25), dark]
    )
    assert colour_scale(np.zeros((2, 2)), 0, 0, np.ones((2, 2), bool)).any()


def test_exposure_doubles_the_light(run):
    def light(image):
        return ((image / 255 + 0.055) / 1.055) ** 2.4

    before, bright = (draw(run, [], CAMERA, exposure=stops)[0] for stops in (0, 1))
    known = (before > 40) & (bright < 255)
    assert known.sum() > 20
    np.testing.assert_allclose(light(bright)[known], 2 * light(before)[known], rtol=0.03)
    assert (draw(run, [], CAMERA, exposure=6)[0][before > 60] == 255).all()
