"""Views that no photographer takes: from inside the object, through one huge point."""

from dataclasses import replace

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.engine.raster.footprint import FOOTPRINTS
from pp_cl.errors import UserError
from pp_cl.reference import dense as oracle
from pp_cl.selftest.points import PairedPoints, make_camera

pytestmark = pytest.mark.kernels


def check(dev, rng, camera, positions, radius, kind, gamma=0.05, depth_range=oracle.DEPTH_RANGE):
    """Compare a scene's fragments, features and gradients with the oracle; returns the scene. Left
    out are pixels where rounding decides whether there is a fragment, or dominates a falloff.
    """
    # a Gaussian's centre may lie hundreds of pixels outside the image, where float32 rounds it by
    # 3e-5 pixels, and its deviation is half a pixel
    n, unit = len(positions), 10 if kind == "gaussian" else 1
    opacity, point_features = np.float32(rng.uniform(0, 1, n)), rng.normal(size=(n, 16))
    scene = PairedPoints(dev, camera, positions, radius, kind=kind, depth_range=depth_range)
    geometry = scene.exact()
    fragments, clear = scene.fragments(), geometry["margin"] > 1e-3
    assert np.array_equal(fragments[clear], geometry["fragment"][clear]) and (~clear).mean() < 0.02
    inner = (geometry["margin"] > 1e-2).all(axis=0)
    assert inner.mean() > 0.5
    blend = oracle.blend(geometry | {"fragment": fragments}, opacity, gamma)
    features = scene.blend(opacity, gamma, point_features).reshape(-1, 16)
    assert np.abs(features - oracle.features(blend, point_features))[inner].max() < 1e-4 * unit
    grad = rng.normal(size=(len(inner), 16)) * inner[:, None]
    gradients = scene.gradients(grad)
    expected = oracle.gradients(geometry | {"fragment": fragments}, blend, point_features, grad)
    assert relative_error(gradients["features"], expected[0]) < 1e-5 * unit
    assert relative_error(gradients["opacity"], expected[1]) < 5e-5 * unit
    return scene


@pytest.mark.parametrize("kind", FOOTPRINTS)
@pytest.mark.parametrize("radius", [0.01, 0.3])
def test_from_inside_the_object(dev, rng, kind, radius):
    camera = replace(make_camera(28, 20), fx=6.5, fy=6.5)
    positions = camera.eye + rng.uniform(-1, 1, (400, 3))
    if kind == "gaussian":  # as wide as the others
        radius /= oracle.DEVIATIONS
    scene = check(dev, rng, camera, positions, radius, kind, depth_range=(0.05, 4.0))
    assert 20 < scene.seen.size < 300


@pytest.mark.parametrize("kind", FOOTPRINTS)
def test_across_the_near_sphere_and_the_plane_of_the_eye(dev, rng, kind):
    camera = replace(make_camera(24, 24), fx=5.0, fy=5.0)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = np.float32(rng.uniform(0.01, 0.8, 300))
    if kind == "gaussian":  # culled by one radius for all
        radius[:] = 0.1
    front = 0.5 + rng.uniform(-0.1, 0.1, 300)
    positions = camera.eye + directions * (front + radius)[:, None]
    scene = check(dev, rng, camera, positions, radius, kind, depth_range=(0.5, 3.0))
    placed = scene.projected.point_record.get()[:, :4].view(np.float32)
    left_out = scene.projected.point_count.get() == 0
    assert (left_out[front < 0.5 - 1e-4]).all() and (~left_out).sum() > 40
    assert (placed[~left_out, 2] < radius[~left_out]).any()  # some reach the plane of the eye


@pytest.mark.parametrize("kind", ["soft", "disc"])
@pytest.mark.parametrize("size", [(1, 1), (3, 257), (64, 48)])
def test_one_point_over_the_whole_image(dev, rng, kind, size):
    camera = replace(make_camera(*size), fx=300.0, fy=300.0, cx=size[0] / 2, cy=size[1] / 2)
    scene = check(dev, rng, camera, camera.eye + 4 * camera.pose[:, 2:3].T, 1.9, kind, gamma=0.5)
    assert scene.fragments().all()


@pytest.mark.large
def test_more_pairs_than_can_be_numbered(dev):
    camera = replace(make_camera(4096, 4096), fx=4e5, fy=4e5, cx=2048.0, cy=2048.0)
    straight = camera.eye + 4 * camera.pose[:, 2:3].T
    with pytest.raises(UserError, match="--points"):
        PairedPoints(dev, camera, np.repeat(straight, 2**16 + 1, axis=0), 1.9)
