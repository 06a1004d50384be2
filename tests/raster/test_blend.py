"""The blend against its float64 twin, and its gradients against finite differences of that twin."""

import numpy as np
import pytest
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.raster.project import KINDS
from pp_cl.reference import dense as oracle
from pp_cl.reference.differences import numeric_gradient
from pp_cl.selftest.points import GAMMAS, Blended, PairedPoints


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gamma", GAMMAS)
def test_features(dev, rng, kind, gamma):
    blended = Blended(dev, rng, kind=kind, gamma=gamma)
    assert (
        relative_error(blended.features, oracle.features(blended.blend, blended.point_features))
        < 2e-4
    )
    assert (blended.features[~blended.geometry["hit"].any(axis=0)] == 1).all()


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("size", [(1, 1), (31, 33)])
def test_sizes(dev, rng, n, size):
    blended = Blended(dev, rng, n=n, size=size)
    assert (
        relative_error(blended.features, oracle.features(blended.blend, blended.point_features))
        < 1e-4
    )
    gradients, expected = blended.gradients(), blended.reference_gradients()
    assert relative_error(gradients["features"], expected[0]) < 1e-4
    assert relative_error(gradients["opacity"], expected[1]) < 1e-4


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gamma", GAMMAS)
@pytest.mark.parametrize("mean", [False, True])
@pytest.mark.parametrize("max_tracked", [0, 3])
def test_gradients(dev, rng, kind, gamma, mean, max_tracked):
    blended = Blended(dev, rng, kind=kind, gamma=gamma, mean=mean, max_tracked=max_tracked)
    gradients, expected = blended.gradients(), blended.reference_gradients(max_tracked, mean)
    assert relative_error(gradients["features"], expected[0]) < 2e-4
    assert relative_error(gradients["opacity"], expected[1]) < 5e-4
    unseen = ~blended.geometry["hit"].any(axis=1)
    assert unseen.any()
    assert (gradients["features"][unseen] == 0).all() and (gradients["opacity"][unseen] == 0).all()


@pytest.mark.parametrize("gamma", GAMMAS)
def test_gradients_against_finite_differences(dev, rng, gamma):
    blended = Blended(dev, rng, n=60, gamma=gamma)
    gradients = blended.gradients()

    def loss(opacity, point_features):
        blend = oracle.blend(blended.geometry, opacity, gamma)
        return (oracle.features(blend, point_features) * blended.grad).sum()

    opacity = blended.opacity.astype(np.float64)
    inside = np.flatnonzero(opacity > 0)  # the oracle has no logarithm of what lies below 0
    numeric = numeric_gradient(lambda o: loss(o, blended.point_features), opacity, 1e-6, inside)
    assert relative_error(gradients["opacity"][inside], numeric) < 5e-4
    zero = np.flatnonzero(opacity == 0)
    start = loss(opacity, blended.point_features)
    one_sided = [
        (loss(opacity + 1e-7 * (np.arange(60) == i), blended.point_features) - start) / 1e-7
        for i in zero
    ]
    assert relative_error(gradients["opacity"][zero], one_sided) < 1e-3
    assert np.abs(one_sided).max() > 0.1

    some = rng.choice(60 * 16, 50, replace=False)
    numeric = numeric_gradient(lambda f: loss(opacity, f), blended.point_features, 1e-4, some)
    assert relative_error(gradients["features"].ravel()[some], numeric) < 1e-4


@pytest.mark.parametrize("gamma", GAMMAS)
@pytest.mark.parametrize("mean", [False, True])
def test_sphere_gradients_against_finite_differences(dev, rng, gamma, mean):
    n, step = 30, 1e-6
    blended = Blended(dev, rng, n=n, kind="sphere", gamma=gamma, mean=mean)
    blended.radius[-1] = 0.01  # below a pixel
    blended.positions[-1] = 0
    opacity = blended.opacity
    blended.scene = PairedPoints(
        dev, blended.camera, blended.positions, blended.radius, kind="sphere"
    )
    blended.scene.blend(opacity, gamma, blended.point_features, mean=mean)
    hit = blended.scene.hits()
    gradients = blended.scene.sphere_gradients(blended.grad)

    def loss(positions, radius):
        geometry = oracle.geometry(blended.camera, positions, radius, "sphere") | {"hit": hit}
        blend = oracle.blend(geometry, opacity, gamma)
        return (oracle.features(blend, blended.point_features) * blended.grad).sum()

    scale = np.maximum(hit.sum(axis=1), 1) if mean else np.ones(n)
    radius = blended.radius.astype(np.float64)
    numeric = (
        numeric_gradient(lambda p: loss(p, radius), blended.positions, step).reshape(n, 3)
        / scale[:, None]
    )
    assert relative_error(gradients["positions"], numeric) < 2e-3
    assert np.abs(gradients["positions"][-1]).max() > 0
    numeric = numeric_gradient(lambda r: loss(blended.positions, r), radius, step) / scale
    assert relative_error(gradients["radius"], numeric) < 2e-3


def test_two_runs_give_the_same_bits(dev):
    runs = []
    for _ in range(2):
        blended = Blended(dev, np.random.default_rng(3), n=3000, radius=0.2)
        runs.append([blended.features, *blended.gradients().values()])
    assert all(np.array_equal(a, b) for a, b in zip(*runs, strict=True))
