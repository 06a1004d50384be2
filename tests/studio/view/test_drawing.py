from dataclasses import replace

import numpy as np
import pytest
from support.scenes import ring_cameras

from pp_cl.engine.network.specular import Specular
from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.run import load
from pp_studio.view.drawing import (
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
    return load(trained, dev)


@pytest.fixture
def views(run):
    return run.scene("train").splits["train"]


def test_every_quantity_is_another_image(run, views):
    images = {show: draw(run, views, CAMERA, show) for show in SHOWN}
    assert len({image.tobytes() for image, _ in images.values()}) == len(SHOWN)
    assert {image.shape for image, _ in images.values()} == {(48, 48, 3), (24, 24, 3)}
    low, high = (float(word) for word in images["depth"][1].split(" to "))
    assert 0 < low < 4 < high


def test_the_error_is_that_of_the_nearest_view_from_its_own_camera(run, views):
    view = views[5]
    near = replace(view.camera, pose=view.camera.pose + 1e-3 * np.eye(3, 4, 3))
    error, line = draw(run, views, near, "error")
    photo, name = draw(run, views, near, "photograph")
    assert line == f"{view.name}, error x4" and name == view.name
    rendering = to_8bit(run.render(view.camera).colour).astype(int)
    expected = np.minimum(4 * np.abs(rendering - photo), 255)
    assert np.abs(error - expected).max() <= 5  # both are rounded, then scaled by four
    assert photo.min() < 250 and error.max() > 5
    with pytest.raises(UserError, match="photographs"):
        draw(run, [], near, "error")


def test_a_share_of_the_points_is_of_each_member_and_keeps_the_specular_layer(run):
    run.model.specular = Specular(run.dev)
    count = run.model.cloud.count
    thinned = most_opaque(run.varied(others=[run.varied()]), 0.25)
    for member in (thinned, *thinned.others):
        assert member.model.cloud.count == round(count / 4)
        assert member.model.specular is run.model.specular


def test_fragments_are_those_of_the_pairs(run, monkeypatch):
    monkeypatch.setattr(run.renderer, "supersampling", 1)  # views until "weights" have one sample
    camera = replace(CAMERA, width=45, height=43)  # the renderer must pad it
    image, line = draw(run, [], camera, "fragments")
    view = run.renderer.forward(camera, run.gamma, until="weights")
    fragments, _ = view.fragments()
    assert line == f"0 to {fragments.max()} fragments" and fragments.max() > 1
    np.testing.assert_array_equal(image, colour_scale(fragments, 0, fragments.max(), fragments > 0))


def test_the_nearest_view_counts_place_and_direction():
    cameras, centre = ring_cameras(6, 48), np.zeros(3)
    assert [nearest_view(cameras, camera, centre) for camera in cameras] == list(range(6))
    away = replace(cameras[2], pose=cameras[2].pose * [-1, 1, -1, 1])  # it looks outwards
    assert nearest_view([away, cameras[2]], cameras[2], centre) == 1


def plane_depth(normal, distance):
    """(H, W) depth of the plane normal . x = distance (world axes) along the camera's axis."""
    return (distance - normal @ CAMERA.eye) / (CAMERA.rays() @ normal)


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
