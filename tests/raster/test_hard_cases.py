"""Numerically hard cases of the blend, one by one: where a naive Eq. (1) overflows, divides by
zero, or hangs.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.reference import dense as oracle
from pp_cl.selftest.points import AXIS as CAMERA
from pp_cl.selftest.points import FAR, PairedPoints, blend_on_axis, depth_at

pytestmark = pytest.mark.kernels


def test_nearest_possible_point_at_the_final_gamma(dev):
    """exp(z/gamma) = e^100 at z = 1 is above the largest float."""
    radius = 2.0**-10
    positions = np.stack([np.zeros(3), np.zeros(3), depth_at([1.0, 0.99, 0.5]) + radius], -1)
    scene = PairedPoints(dev, CAMERA, positions, radius, kind="sphere")
    features = scene.blend([1, 1, 1], 0.01, np.eye(3, 16))
    e = np.exp([0.0, -1.0, -50.0])
    assert np.allclose(features[0, 0, :3], e / e.sum(), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("opacity", [1.0, 0.3, 1e-3, 1e-38])
def test_the_smallest_gamma(dev, opacity):
    """gamma = 1e-5: exponents of 1e5; the nearest of equal opacities takes all, or shares with the
    background.
    """
    scene, weight = blend_on_axis(dev, [0.9, 0.8, 0.1], [opacity] * 3, 1e-5)
    gradients = scene.gradients(np.ones((1, 1, 16)))
    assert np.isfinite(weight).all() and all(np.isfinite(g).all() for g in gradients.values())
    expected = oracle.blend(dense_geometry(scene), [np.float32(opacity)] * 3, 1e-5)["weight"][:, 0]
    assert np.allclose(weight, expected, rtol=1e-2, atol=1e-30)


def dense_geometry(scene):
    """oracle.geometry of a scene on the axis."""
    return oracle.geometry(scene.camera, scene.projected.point_camera.get()[:, :3], 0.001, "soft")


@pytest.mark.parametrize("gamma", [0.1, 0.01, 1e-5])
@pytest.mark.parametrize("count", [2, 3, 16, 17, 100])
def test_equal_depths_share_equally(dev, gamma, count):
    _, weight = blend_on_axis(dev, [0.7] * count, [1.0] * count, gamma)
    assert (weight == weight[0]).all()
    assert abs(weight.sum() - 1) < 1e-2 if gamma == 0.1 else abs(weight.sum() - 1) < 1e-5


def test_equal_depths_are_tracked_in_index_order(dev):
    scene, _ = blend_on_axis(dev, [0.7] * 5, [1.0] * 5, 0.1, max_tracked=2)
    gradients = scene.gradients(np.ones((1, 1, 16)))
    assert (gradients["features"].any(axis=1)).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("gamma", [0.1, 0.01, 1e-5])
def test_all_opacities_zero(dev, gamma):
    """The picture is the background, and yet every opacity has a gradient by which it can come
    back.
    """
    scene, weight = blend_on_axis(dev, [0.9, 0.5, 0.2], [0.0, 0.0, 0.0], gamma)
    assert (weight == 0).all() and (scene.features.get() == 1).all()
    gradients = scene.gradients(np.ones((1, 1, 16)))
    closeness = dense_geometry(scene)["closeness"][:, 0]
    expected = closeness * (1 - 16) * np.exp(-1e-6 / gamma)  # d G.(f - bg) exp(-M)/D with D = 1
    assert relative_error(gradients["opacity"], expected) < 1e-5
    assert (gradients["features"] == 0).all()


def test_a_zero_opacity_behind_an_opaque_point_hardly_matters(dev):
    scene, weight = blend_on_axis(dev, [0.9, 0.5], [1.0, 0.0], 0.01)
    gradient = scene.gradients(np.ones((1, 1, 16)) * np.arange(16))["opacity"]
    assert weight[1] == 0
    assert gradient[1] != 0 and abs(gradient[1]) < 1e-30


def test_a_near_faint_point_does_not_hide_a_far_opaque_one(dev):
    """The exponent scales with the opacity: this is no alpha compositing."""
    _, weight = blend_on_axis(dev, [0.9, 0.6], [0.5, 1.0], 0.01)
    assert relative_error(weight[0] / weight[1], 0.5 * np.exp(-15.0)) < 1e-3


def test_softness(dev):
    """0.04 units of depth are one e-fold at gamma = 0.01 and a range of 4."""
    _, weight = blend_on_axis(dev, [0.5, 0.49], [1.0, 1.0], 0.01)
    assert abs(np.log(weight[0] / weight[1]) - 1) < 1e-3


@pytest.mark.parametrize("kind", ["disc", "soft", "sphere"])
def test_points_behind_and_on_the_plane_of_the_eye(dev, kind):
    positions = np.array([[0, 0, -3.0], [0, 0, 0], [3.0, 0, 0], [0, 3.0, 1e-9], [0, 0, 3.0]])
    scene = PairedPoints(dev, CAMERA, positions, 0.01, kind=kind, depth_range=(1e-3, FAR))
    assert scene.projected.point_camera.get()[:, 3].tolist() == [-1, -1, -1, -1, 3]
    assert scene.seen.tolist() == [4]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38, -3e38])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_positions_that_are_not_finite(dev, bad, axis):
    positions = np.array([[0, 0, 3.0], [0, 0, 3.0], [0.001, 0, 4.0]])
    positions[1, axis] = bad
    scene = PairedPoints(dev, CAMERA, positions, 0.1, kind="sphere")
    assert scene.seen.tolist() == [0, 2]
    features = scene.blend(np.ones(3), 0.01, np.ones((3, 16)) * 2)
    gradients = scene.gradients(np.ones((1, 1, 16))) | scene.sphere_gradients(np.ones((1, 1, 16)))
    assert np.isfinite(features).all()
    assert all(np.isfinite(g).all() and not g[1].any() for g in gradients.values())


def test_a_ray_through_the_centre_of_a_sphere_has_gradients(dev):
    """rho = 0: d has no slope there, and nothing may be divided by it."""
    scene = PairedPoints(dev, CAMERA, np.array([[0, 0, 3.0]]), 0.5, kind="sphere")
    scene.blend([0.5], 0.1, np.full((1, 16), 2.0))
    gradients = scene.sphere_gradients(np.ones((1, 1, 16)))
    assert gradients["positions"][0, 2] < 0 and (gradients["positions"][0, :2] == 0).all()
    assert gradients["radius"][0] > 0


@pytest.mark.exact
def test_a_hit_on_the_very_rim(dev):
    """d = 0 with an exponent above that of the largest float: no weight, no gradient, no NaN."""
    # rho = |(3, 0, 4) - 5 (0, 0, 1)|
    scene = PairedPoints(
        dev,
        CAMERA,
        np.array([[3.0, 0, 4.0]]),
        np.sqrt(10.0),
        kind="sphere",
        depth_range=(1.8, 10.0),
    )
    assert scene.pairs.total == 1 and scene.pairs.pair_point_closeness.get()[0, 1] == 0
    assert (scene.blend([1.0], 0.005, np.full((1, 16), 2.0)) == 1).all()
    gradients = scene.gradients(np.ones((1, 1, 16))) | scene.sphere_gradients(np.ones((1, 1, 16)))
    assert all((g == 0).all() for g in gradients.values())


def test_the_early_stop_spares_points_beyond_far(dev):
    """At z < 0 a lower opacity has more weight than the opacity 1."""
    scene = PairedPoints(dev, CAMERA, np.array([[0, 0, FAR + 0.3]]), 0.4)
    weight = 1 - scene.blend([0.133], 0.01, np.zeros((1, 16)), early_stop=0.01)[0, 0, 0]
    expected = 0.133 * np.exp(-0.133 * 0.075 / 0.01)
    assert relative_error(weight, expected / (1 + expected)) < 1e-3


def test_a_point_at_the_eye(dev):
    """It has no direction, and is left out even where near = 0 would let it in."""
    scene = PairedPoints(dev, CAMERA, np.zeros((1, 3)), 0.0, depth_range=(0.0, FAR))
    assert scene.projected.point_camera.get().tolist() == [[0, 0, 0, -1]]


@pytest.mark.parametrize("gamma", [0.1, 0.01])
def test_thousands_of_hits_in_one_pixel(dev, rng, gamma):
    z, opacity = rng.uniform(0.1, 0.99, 20_000), np.float32(rng.uniform(0, 1, 20_000))
    scene, weight = blend_on_axis(dev, z, opacity, gamma)
    blend = oracle.blend(dense_geometry(scene), opacity, gamma)
    assert relative_error(weight, blend["weight"][:, 0]) < 1e-4
    expected = oracle.features(blend, np.resize(np.eye(16), (20_000, 16)))
    assert relative_error(scene.features.get().reshape(1, 16), expected) < 1e-4


def test_an_empty_view(dev):
    scene = PairedPoints(
        dev, replace(CAMERA, width=31, height=33), np.array([[100.0, 0, 3.0], [0, 0, 300.0]]), 0.01
    )
    assert scene.pairs.total == 0 and scene.seen.size == 0
    assert (scene.blend([1, 1], 0.01, np.zeros((2, 16))) == 1).all()
    gradients = scene.gradients(np.ones((33, 31, 16)))
    assert not gradients["features"].any() and not gradients["opacity"].any()


def test_one_point_and_one_pixel(dev):
    scene, weight = blend_on_axis(dev, [0.5], [0.057], 0.01)
    assert scene.pairs.total == 1
    assert abs(weight[0] - 0.5) < 0.01  # a lone point is half visible at this opacity


def test_a_point_as_large_as_the_view(dev):
    camera = replace(CAMERA, width=257, height=33, fx=200.0, fy=200.0, cx=128.0, cy=16.0)
    scene = PairedPoints(dev, camera, np.array([[0, 0, 5.0]]), 2.9, kind="sphere")
    assert scene.hits().all()
