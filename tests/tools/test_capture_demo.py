"""The photographs for capture belong to one world, and cameras are compared up to a similarity."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tools.capture_demo import align, cameras

pytestmark = pytest.mark.slow


def test_cameras_are_compared_up_to_a_similarity(rng):
    true = cameras(100)[:12]
    turn, scale, shift = Rotation.random(random_state=1).as_matrix(), 3.7, rng.normal(size=3)

    def moved(camera, noise=0.0, degrees=0.0):
        small = Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
        rotation = turn @ camera.pose[:, :3] @ small
        eye = scale * turn @ (camera.eye + noise * rng.normal(size=3)) + shift
        return replace(camera, pose=np.column_stack([rotation, eye]))

    exact = align([moved(camera) for camera in true], true)
    assert exact.position < 1e-9 and exact.degrees < 1e-5
    turned = align([moved(true[0], degrees=2.0), *(moved(c) for c in true[1:])], true)
    assert turned.degrees == pytest.approx(2.0, abs=0.01)
    noisy = align([moved(camera, noise=0.01) for camera in true], true)
    assert 0.005 < noisy.position < 0.03
