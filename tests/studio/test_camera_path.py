from dataclasses import replace

import numpy as np
import pytest
from support.ball_views import CENTRE, ball_camera
from support.scenes import ring_cameras

from pp_cl.engine.camera import Camera
from pp_cl.scene.gaze import looked_at, up_of
from pp_studio.camera_path import MARGIN, around, between, through


def turned(cameras, rotation, shift):
    poses = [np.column_stack([rotation @ c.pose[:, :3], rotation @ c.eye + shift]) for c in cameras]
    return [replace(camera, pose=pose) for camera, pose in zip(cameras, poses, strict=True)]


@pytest.fixture
def tilted(rng):
    """(cameras, points, up) of an object in a world where up is no axis."""
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    shift = np.array([5.0, -3.0, 2.0])
    points = rng.uniform(-1, 1, (500, 3)) * [0.9, 0.4, 0.7]
    cameras = turned(ring_cameras(12, 64), rotation, shift)
    return cameras, points @ rotation.T + shift, rotation[:, 2]


def test_up_is_found_whatever_the_axes(tilted):
    """It is found from a whole ring of cameras, from one side, and from a single camera."""
    cameras, _, up = tilted
    np.testing.assert_allclose(up_of(cameras), up, atol=1e-6)
    assert up_of(cameras[:3]) @ up > 0.99
    np.testing.assert_allclose(up_of(cameras[:1]), -cameras[0].pose[:, 1], atol=1e-6)


def test_up_is_not_fooled_by_cameras_that_all_look_down():
    """The mean of their upper edges leans outwards only if they all stand on one side."""
    cameras = ring_cameras(4, 64)[:2]
    assert up_of(cameras)[2] > 0.95


@pytest.mark.parametrize("path", ["orbit", "spiral"])
def test_the_object_is_whole_and_nothing_jumps(tilted, path):
    cameras, points, up = tilted
    frames = around(path, cameras, points, cameras[0].resized(120, 60), 48)
    assert len(frames) == 48
    for camera in frames:
        assert (camera.width, camera.height) == (120, 60)
        assert np.linalg.det(camera.pose[:, :3]) == pytest.approx(1)
        assert abs(camera.pose[:, 0] @ up) < 1e-6 and camera.pose[:, 1] @ up < 0  # level, upright
        x, y, z = ((points - camera.eye) @ camera.pose[:, :3]).T
        assert (z > 0).all()
        assert (np.abs(camera.fx * x / z) <= MARGIN * 60 + 1e-6).all()
        assert (np.abs(camera.fy * y / z) <= MARGIN * 30 + 1e-6).all()
    eyes = np.array([camera.eye for camera in frames])
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    assert steps.max() < 1.1 * np.median(steps)
    if path == "orbit":
        assert np.linalg.norm(eyes[0] - eyes[-1]) == pytest.approx(steps[0], rel=1e-6)


def test_a_spiral_of_one_ring_makes_one_turn(rng):
    points = rng.uniform(-1, 1, (50, 3))
    ring = [
        Camera.look_at((4 * np.cos(a), 4 * np.sin(a), rise), (0, 0, 0), fx=60, width=64, height=64)
        for a, rise in zip(np.arange(24) / 24 * 2 * np.pi, rng.uniform(0.9, 1.1, 24), strict=True)
    ]
    high = [
        Camera.look_at((3 * np.cos(a), 3 * np.sin(a), 3), (0, 0, 0), fx=60, width=64, height=64)
        for a in np.arange(24) / 24 * 2 * np.pi
    ]
    for cameras, turns in ((ring, 1), ([*ring, *high], 2)):
        frames = around("spiral", cameras, points, cameras[0], 40)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        x, y, _ = np.transpose([camera.eye - middle for camera in frames])
        angles = np.unwrap(np.arctan2(y, x))
        assert angles[-1] - angles[0] == pytest.approx(turns * 2 * np.pi * 39 / 40, rel=1e-3)


def test_a_camera_above_the_object_is_no_division_by_zero():
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), fx=50, width=64, height=64)
    points = np.array([[-1.0, -1, -1], [1, 1, 1]])
    for frame in around("orbit", [camera], points, camera, 5):
        assert np.isfinite(frame.pose).all()


def test_the_optical_axes_meet_where_the_cameras_look(rng):
    cameras = [ball_camera(CENTRE + 4 * d, CENTRE) for d in rng.normal(size=(7, 3))]
    np.testing.assert_allclose(looked_at(cameras), CENTRE, atol=1e-9)
    assert np.isfinite(looked_at(cameras[:1])).all()


def test_cameras_between_others_see_the_same_from_half_way(tilted):
    cameras, _, _ = tilted
    centre = looked_at(cameras)
    eyes = np.stack([camera.eye for camera in cameras])
    for i, camera in enumerate(between(cameras)):
        distance = np.linalg.norm(camera.eye - centre)
        assert distance == pytest.approx(np.linalg.norm(eyes[i] - centre), rel=0.05)
        apart = np.linalg.norm(eyes - camera.eye, axis=1)
        assert apart.min() > 0.2  # the ring's cameras are 2 apart
        x, y, depth = camera.project(centre)
        assert (x, y) == pytest.approx(cameras[i].project(centre)[:2]) and depth > 0
        np.testing.assert_allclose(camera.pose[:, :3].T @ camera.pose[:, :3], np.eye(3), atol=1e-9)
    assert between(cameras[:1]) == cameras[:1]
    assert between([cameras[0], cameras[6]]) == [cameras[0], cameras[6]]  # for opposite cameras


def test_a_path_goes_smoothly_through_its_cameras():
    keys = [camera.with_angle(0.5 + 0.1 * i) for i, camera in enumerate(ring_cameras(9, 48)[:4])]
    path = through(keys, 31)
    for key, camera in zip(keys, path[::10], strict=True):
        np.testing.assert_allclose(camera.pose, key.pose, atol=1e-9)
        np.testing.assert_allclose(camera.fx, key.fx)
    for camera in path:
        np.testing.assert_allclose(camera.pose[:, :3].T @ camera.pose[:, :3], np.eye(3), atol=1e-9)
    steps = np.linalg.norm(np.diff([camera.eye for camera in path], axis=0), axis=1)
    assert np.abs(np.diff(steps)).max() < 0.2 * steps.max()  # no jerk
    assert len(through(keys[:2], 5)) == 5 and through(keys[:1], 5) == keys[:1]
