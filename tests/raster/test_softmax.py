"""The softmax weights against their float64 twin, and what is dropped of them."""

import numpy as np
import pytest
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES, large

from pp_cl.raster.project import KINDS
from pp_cl.reference import dense as oracle
from pp_cl.selftest.points import GAMMAS, Blended

TAUS = (1e-4, 1e-2, 0.3)
TRACKED, UNTRACKED, DROPPED = range(3)  # cl/raster/pair_role.h


def dropped_weights(scene):
    """(HW,) the weight that each pixel dropped, or a bound above it."""
    return scene.weighing.dropped(scene.pairs, scene.weights).get()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gamma", GAMMAS)
def test_weights(dev, rng, kind, gamma):
    blended = Blended(dev, rng, kind=kind, gamma=gamma)
    assert np.abs(blended.weight - blended.blend["weight"]).max() < 2e-4
    assert np.array_equal(blended.scene.weights.shaded.get(), blended.scene.seen)


def test_gradients_take_no_program_of_their_own(dev, rng, monkeypatch):
    monkeypatch.setattr(dev, "_programs", {})
    Blended(dev, rng).gradients()
    assert [name for name, _ in dev._programs].count("raster/softmax") == 1


@pytest.mark.parametrize("early_stop", [0.001, 0.05, 0.5])
def test_early_stop(dev, rng, early_stop):
    blended = Blended(dev, rng, n=500, gamma=0.02, radius=0.4, early_stop=early_stop)
    dropped = blended.geometry["hit"] & ~blended.blend["hit"]
    assert dropped.sum() > 100 and (blended.blend["hit"].sum(axis=0) > 16).any()
    assert (
        relative_error(blended.features, oracle.features(blended.blend, blended.point_features))
        < 1e-4
    )
    gradients, expected = blended.gradients(), blended.reference_gradients()
    assert relative_error(gradients["features"], expected[0]) < 1e-4
    assert relative_error(gradients["opacity"], expected[1]) < 2e-4
    whole = oracle.blend(blended.geometry, blended.opacity, 0.02)
    assert whole["weight"][dropped].max() < early_stop


@pytest.mark.parametrize("n", [*AWKWARD_SIZES, large(3000)])
@pytest.mark.parametrize("gamma", GAMMAS)
@pytest.mark.parametrize("tau", TAUS)
@pytest.mark.exact
def test_tau(dev, n, gamma, tau):
    """What is left hardly changes, what is dropped weighs no more than is said, and that is at most
    tau.
    """
    exact, blended = (
        Blended(dev, np.random.default_rng(5), n, gamma=gamma, radius=0.3, tau=t)
        for t in (0.0, tau)
    )
    hit = exact.geometry["hit"]
    dropped = hit & (blended.role == DROPPED)
    left = blended.weight[hit & ~dropped] / exact.weight[hit & ~dropped]
    # a tail that was never weighed is missing in their sum
    assert (left >= 1 - 1e-6).all() and (left <= 1 + tau).all()
    if n > 1:
        assert dropped.any()

    true = np.where(dropped, exact.weight.astype(np.float64), 0).sum(axis=0)
    said = dropped_weights(blended.scene)
    assert (said <= tau).all() and (true <= said * (1 + 1e-5)).all()
    assert not dropped_weights(exact.scene).any()

    shaded = blended.scene.weights.shaded.get()
    np.testing.assert_array_equal(shaded, np.flatnonzero((hit & ~dropped).any(axis=1)))
    values = np.vstack([exact.point_features, np.ones(16)])  # the background's are 1
    bound = said.max() * (values.max(axis=0) - values.min(axis=0))
    assert (np.abs(blended.features - exact.features).max(axis=0) <= bound + 1e-5).all()
    gradients = blended.gradients()
    assert all(np.isfinite(g).all() for g in gradients.values())
    assert not gradients["features"][~np.isin(np.arange(n), shaded)].any()


def test_tau_drops_from_the_back(dev, rng):
    """The last hit that is left would not fit; an eighth of tau may go to a bound of what was never
    weighed.
    """
    blended = Blended(dev, rng, n=500, gamma=0.1, radius=0.4, tau=0.05)
    whole, order = blended.blend["weight"], oracle.order(blended.geometry)
    said, fits = dropped_weights(blended.scene), 0
    for q in np.flatnonzero(blended.geometry["hit"].any(axis=0)):
        points = np.flatnonzero(blended.geometry["hit"][:, q])
        points = points[np.argsort(order[points, q])]
        kept = blended.role[points, q] == TRACKED
        last = np.flatnonzero(kept).max(initial=-1)
        if last >= 0 and last + 1 < len(points):
            behind = whole[points[last + 1 :], q].sum()
            assert behind + whole[points[last], q] > 0.05 * (7 / 8 - 1e-3)
            fits += 1
        assert (whole[points[~kept], q] <= 0.05).all() and said[q] <= 0.05
    assert fits > 100


def test_tau_gradients_are_those_of_what_is_left(dev, rng):
    """dL/df = sum b G over the pairs that are left."""
    blended = Blended(dev, rng, n=500, gamma=0.02, radius=0.4, tau=0.02)
    weight = np.where(blended.role == TRACKED, blended.weight, 0).astype(np.float64)
    assert relative_error(blended.gradients()["features"], weight @ blended.grad) < 1e-4
    expected = blended.reference_gradients()[0]
    assert 1e-4 < relative_error(weight @ blended.grad, expected) < 0.05


def test_tau_with_gradients_of_spheres(dev, rng):
    """Points that are not shaded have no features: nothing reads them."""
    blended = Blended(dev, rng, n=500, kind="sphere", gamma=0.02, radius=0.4, tau=0.1)
    missing = ~np.isin(np.arange(500), blended.scene.weights.shaded.get())
    assert np.isnan(blended.scene.point_features.get()[missing]).all() and missing.sum() > 50
    gradients = blended.scene.sphere_gradients(blended.grad)
    assert all(np.isfinite(g).all() and not g[missing].any() for g in gradients.values())


def test_untracked_hits_without_weight_are_shaded(dev, rng):
    """A weight may underflow to 0 beyond max_tracked; its point is in the pixels' lists, so it must
    be shaded.
    """
    blended = Blended(dev, rng, n=300, gamma=1e-3, radius=0.4, max_tracked=1, early_stop=1e-30)
    untracked_zero = (blended.role == UNTRACKED) & (blended.weight == 0)
    assert untracked_zero.any() and np.isfinite(blended.features).all()
