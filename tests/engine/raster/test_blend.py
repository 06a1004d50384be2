"""Check gradients by finite differences of the float64 twins that the selftest uses."""

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.raster.highest_weights import record_weights
from pp_cl.engine.raster.weights import BLENDS
from pp_cl.engine.training.depth_loss import depth_gradient
from pp_cl.reference import dense as oracle
from pp_cl.reference.differences import numeric_gradient
from pp_cl.reference.loss import bending
from pp_cl.selftest.points import (
    AXIS,
    Blended,
    PairedPoints,
    blend_on_axis,
)

CASES = [("softmax", 0.1), ("softmax", 0.01), ("alpha", 0.1)]


@pytest.mark.parametrize("rule, gamma", CASES)
def test_gradients_against_finite_differences(dev, rng, rule, gamma):
    """Opacities include 0 and 1; the softmax takes no logarithm of a value below 0."""
    blended = Blended(dev, rng, n=60, gamma=gamma, rule=rule)
    gradients = blended.gradients()

    def loss(opacity, point_features):
        blend = oracle.blend_by_rule(rule, blended.geometry, opacity, gamma)
        return (oracle.features(blend, point_features) * blended.grad).sum()

    def loss_of_opacity(opacity):
        return loss(opacity, blended.point_features)

    opacity = blended.opacity.astype(np.float64)
    inside, zero = np.flatnonzero(opacity > 0), np.flatnonzero(opacity == 0)
    numeric = numeric_gradient(loss_of_opacity, opacity, 1e-6, inside)
    assert relative_error(gradients["opacity"][inside], numeric) < 5e-4
    start, steps = loss_of_opacity(opacity), 1e-7 * np.eye(60)[zero]
    one_sided = [(loss_of_opacity(opacity + step) - start) / 1e-7 for step in steps]
    assert relative_error(gradients["opacity"][zero], one_sided) < 1e-3
    assert np.abs(one_sided).max() > 0.1

    indices = rng.choice(60 * 16, 50, replace=False)
    numeric = numeric_gradient(lambda f: loss(opacity, f), blended.point_features, 1e-4, indices)
    assert relative_error(gradients["features"].ravel()[indices], numeric) < 1e-4


def test_gradients_of_the_distortion_loss_against_finite_differences(dev, rng):
    blended = Blended(dev, rng, n=60, rule="alpha")
    blended.grad[:] = 0

    def loss(opacity):
        return oracle.distortion(blended.geometry, oracle.alpha(blended.geometry, opacity)).sum()

    numeric = numeric_gradient(loss, blended.opacity.astype(np.float64), 1e-5, np.arange(60))
    assert np.abs(numeric).max() > 0.1
    assert relative_error(blended.gradients(distortion_weight=1.0)["opacity"], numeric) < 1e-5


def test_gradients_of_the_depth_loss_against_finite_differences(dev, rng):
    blended = Blended(dev, rng, n=90, radius=0.6, rule="alpha")
    blended.grad[:] = 0
    scene, geometry, camera = blended.scene, blended.geometry, blended.camera
    axis = oracle.rays(camera)[:, 2] / 0.1

    def surface(opacity):
        weight = oracle.alpha(geometry, opacity)["weight"]
        alpha = weight.sum(axis=0)
        depth = (weight * np.where(weight > 0, geometry["depth"], 0)).sum(axis=0)
        return alpha, axis * depth / np.where(alpha > 0, alpha, 1)

    opacity = blended.opacity.astype(np.float64)
    has_surface = (surface(opacity)[0] >= 0.9).reshape(scene.shape)
    assert has_surface.sum() > 50

    def loss(opacity):
        return bending(surface(opacity)[1].reshape(scene.shape), has_surface)[0]

    view = scene.projected, scene.weights, scene.shape
    depth_grad = depth_gradient(dev, Buffers(dev), *view, voxel_size=0.1, weight=1.0)
    gradients = scene.gradients(blended.grad, depth_gradient=depth_grad)["opacity"]
    inside = np.flatnonzero((opacity > 0) & (opacity < 1))
    numeric = numeric_gradient(loss, opacity, 1e-6, inside)
    assert np.abs(numeric).max() > 1e-3
    assert relative_error(gradients[inside], numeric) < 1e-4


def test_fragments_at_one_depth_and_single_fragments_have_no_distortion_loss(dev):
    for z in ([0.5], [0.5] * 7):
        scene, _ = blend_on_axis(dev, z, [0.5] * len(z), 0.1, rule="alpha")
        gradients = scene.gradients(np.zeros((1, 1, 16)), distortion_weight=1e6)
        assert (gradients["opacity"] == 0).all()


@pytest.mark.exact
@pytest.mark.parametrize("kind", ["soft", "gaussian"])
def test_an_opacity_that_is_nan_comes_through(dev, rng, kind):
    """NaN reaches the pixels that see the point, and the weight by which it is pruned."""
    scene = Blended(dev, rng, 31, kind=kind, rule="alpha").scene
    point = scene.seen[0]
    opacity = np.where(np.arange(31) == point, np.nan, 0.1)
    scene.blend(opacity, 0.1, np.zeros((31, 16)), rule="alpha")
    through = scene.weights.transmittance.get().ravel()
    np.testing.assert_array_equal(np.isnan(through), scene.fragments()[point])
    highest, times_seen = dev.zeros((31,)), dev.zeros((31,))
    view = scene.projected, scene.pairs, scene.weights
    record_weights(dev, scene.buffers, *view, highest, times_seen)
    assert np.isnan(highest.get()[point])


def test_a_softmax_has_no_losses_of_depths(dev, rng):
    blended = Blended(dev, rng)
    for term in ({"distortion_weight": 1.0}, {"depth_gradient": dev.zeros((480, 2))}):
        with pytest.raises(ValueError, match="losses of depths"):
            blended.scene.gradients(blended.grad, **term)


def test_the_softmax_by_hand(dev):
    """0.04 units of depth are one e-fold at gamma = 0.01 and a range of 4; the exponent scales with
    the opacity, so a near faint point does not hide a far opaque one: this is no alpha
    compositing.
    """
    _, (near, far) = blend_on_axis(dev, [0.5, 0.49], [1.0, 1.0], 0.01)
    assert abs(np.log(near / far) - 1) < 1e-3
    _, (near, far) = blend_on_axis(dev, [0.9, 0.6], [0.5, 1.0], 0.01)
    assert near / far == pytest.approx(0.5 * np.exp(-15.0), rel=1e-3)
    _, weight = blend_on_axis(dev, [0.5], [0.057], 0.01)
    assert abs(weight[0] - 0.5) < 0.01  # a lone point is half visible at this opacity
    scene, weight = blend_on_axis(dev, [0.9, 0.5], [1.0, 0.0], 0.01)
    hidden = scene.gradients(np.ones((1, 1, 16)) * np.arange(16))["opacity"][1]
    assert weight[1] == 0 and hidden != 0 and abs(hidden) < 1e-30


def test_untracked_fragments_without_weight_are_shaded(dev, rng):
    """A weight may underflow to 0 beyond max_tracked, but its point is in the pixels' lists and
    must be shaded.
    """
    blended = Blended(dev, rng, n=300, gamma=1e-3, radius=0.4, max_tracked=1, early_stop=1e-30)
    listed_zero = blended.geometry["fragment"] & ~blended.dropped & (blended.weight == 0)
    assert listed_zero.any() and np.isfinite(blended.features).all()


@pytest.mark.parametrize("rule", BLENDS)
@pytest.mark.parametrize("early_stop", [0.0, 1e-3])
def test_two_runs_give_the_same_bits(dev, rule, early_stop):
    runs = []
    for _ in range(2):
        rng = np.random.default_rng(3)
        blended = Blended(dev, rng, n=3000, radius=0.2, rule=rule, early_stop=early_stop)
        visible, gradients = blended.scene.weights.visible.get(), blended.gradients()
        runs.append([blended.weight, visible, blended.features, *gradients.values()])
    assert all(np.array_equal(a, b) for a, b in zip(*runs, strict=True))


def test_a_point_at_the_eye(dev):
    scene = PairedPoints(dev, AXIS, np.zeros((1, 3)), 0.0, depth_range=(0.0, 6.0))
    assert scene.pairs.total == 0


def test_the_basis_is_orthonormal(rng):
    directions = rng.normal(size=(400_000, 3))
    basis = oracle.sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    assert np.abs(4 * np.pi * basis.T @ basis / len(basis) - np.eye(9)).max() < 0.02
