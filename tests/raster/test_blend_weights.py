"""What both blends tell about points and pixels."""

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.raster.blend import BLENDS
from pp_cl.raster.blend_weights import DROPPED
from pp_cl.selftest.points import Blended

pytestmark = pytest.mark.parametrize("rule", BLENDS)


@pytest.mark.parametrize("early_stop", [0.0, 0.05])
@pytest.mark.parametrize("max_tracked", [0, 2])
@pytest.mark.exact
def test_points_keep_their_highest_weight(dev, rng, rule, early_stop, max_tracked):
    """Untracked hits count, dropped ones do not; a look counts either way."""
    options = {"early_stop": early_stop, "max_tracked": max_tracked}
    blended = Blended(dev, rng, n=500, gamma=0.02, radius=0.4, rule=rule, **options)
    assert (blended.role == DROPPED).any() == (early_stop > 0)
    before, looks = (dev.upload(x * np.arange(500), np.float32) for x in (2e-3, 1))
    peak, scene = before.copy(), blended.scene
    scene.weighing.raise_peaks(scene.pairs, scene.weights, peak, looks)
    seen = blended.geometry["hit"].any(axis=1)
    np.testing.assert_array_equal(looks.get() - np.arange(500), seen)
    weight = blended.blend["weight"].sum(axis=1)
    raised = weight > before.get()
    assert raised.any() and not raised.all()
    assert relative_error(peak.get(), np.maximum(before.get(), weight)) < 1e-6


@pytest.mark.parametrize("tau", [0.0, 1e-2])
def test_shaded_points_and_dropped_weights(dev, rng, rule, tau):
    blended = Blended(dev, rng, n=500, gamma=0.02, radius=0.4, rule=rule, tau=tau)
    scene, hit = blended.scene, blended.geometry["hit"]
    kept = hit & (blended.role != DROPPED)
    np.testing.assert_array_equal(scene.weights.shaded.get(), np.flatnonzero(kept.any(axis=1)))
    said = scene.weighing.dropped(scene.pairs, scene.weights).get()
    dropped = (hit & ~kept).any(axis=0)
    assert dropped.any() == (tau > 0) and (said[dropped] > 0).all() and (said <= tau).all()
    assert not said[~dropped].any()


@pytest.mark.parametrize("tau", [0.0, 1e-3])
def test_two_runs_give_the_same_bits(dev, rule, tau):
    runs = []
    for _ in range(2):
        rng = np.random.default_rng(3)
        blended = Blended(dev, rng, n=3000, radius=0.2, rule=rule, tau=tau)
        shaded, gradients = blended.scene.weights.shaded.get(), blended.gradients()
        runs.append([blended.weight, shaded, blended.features, *gradients.values()])
    assert all(np.array_equal(a, b) for a, b in zip(*runs, strict=True))
