"""Alpha compositing against its float64 twin, its gradients against finite differences of that
twin, and what is dropped.
"""

import numpy as np
import pytest
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES, large

from pp_cl.raster.blend_weights import DROPPED
from pp_cl.raster.project import KINDS
from pp_cl.reference import dense as oracle
from pp_cl.reference.differences import numeric_gradient
from pp_cl.selftest.points import Blended, PairedPoints, make_camera
from pp_cl.selftest.points import blend_on_axis as on_axis

STOPS = (1e-3, 0.05, 0.5)


def alpha_scene(dev, rng, **options):
    return Blended(dev, rng, rule="alpha", **options)


def blend_on_axis(dev, opacity, **options):
    """(scene, (S,) weights) of hits one behind another in a single pixel."""
    return on_axis(dev, np.linspace(0.9, 0.1, len(opacity)), opacity, 0.1, rule="alpha", **options)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [*AWKWARD_SIZES, large(3000)])
def test_weights_and_features(dev, rng, kind, n):
    blended = alpha_scene(dev, rng, kind=kind, n=n)
    assert np.abs(blended.weight - blended.blend["weight"]).max() < 1e-5
    expected = oracle.features(blended.blend, blended.point_features)
    assert relative_error(blended.features, expected) < 1e-5
    assert (blended.features[~blended.geometry["hit"].any(axis=0)] == 1).all()
    assert np.array_equal(blended.scene.weights.shaded.get(), blended.scene.seen)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mean", [False, True])
@pytest.mark.parametrize("max_tracked", [0, 3])
@pytest.mark.parametrize("early_stop", [0.0, 0.05])
def test_gradients(dev, rng, kind, mean, max_tracked, early_stop):
    options = {"mean": mean, "max_tracked": max_tracked, "early_stop": early_stop}
    blended = alpha_scene(dev, rng, kind=kind, **options)
    gradients, expected = blended.gradients(), blended.reference_gradients(max_tracked, mean)
    assert relative_error(gradients["features"], expected[0]) < 2e-5
    assert relative_error(gradients["opacity"], expected[1]) < 2e-5
    unseen = ~blended.blend["hit"].any(axis=1)
    assert unseen.any()
    assert (gradients["features"][unseen] == 0).all() and (gradients["opacity"][unseen] == 0).all()


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("early_stop", [0.0, 0.05])
def test_a_gradient_of_alpha_is_one_of_a_feature_that_only_the_background_has(
    dev, rng, n, early_stop
):
    """A feature that is 0 in all points is T, since the background's is 1."""
    blended = alpha_scene(dev, rng, n=n, early_stop=early_stop)
    grad_alpha = rng.normal(size=blended.grad.shape[0])
    blended.point_features[:, 15] = 0
    drops = {"early_stop": early_stop, "rule": "alpha"}
    blended.scene.blend(blended.opacity, 0.1, blended.point_features, **drops)
    blended.grad[:, 15] = -grad_alpha
    expected = blended.reference_gradients()
    blended.grad[:, 15] = 0
    gradients = blended.scene.gradients(blended.grad, grad_alpha)
    assert relative_error(gradients["opacity"], expected[1]) < 2e-5
    assert relative_error(gradients["features"][:, :15], expected[0][:, :15]) < 2e-5
    without = blended.scene.gradients(blended.grad)
    assert relative_error(without["opacity"], expected[1]) > 0.01 or n == 1
    transmittance = blended.scene.weights.transmittance.get()
    exact = 1 - blended.blend["weight"].sum(axis=0)
    assert np.abs(transmittance - exact).max() < 1e-5


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("option", [{}, {"mean": True}, {"max_tracked": 3}, {"early_stop": 0.05}])
def test_the_gradient_of_the_spread_is_added(dev, rng, n, option):
    blended = alpha_scene(dev, rng, n=n, **option)
    without, gradients = blended.gradients(), blended.gradients(spread_weight=2.0)
    of_points = {name: x for name, x in option.items() if name != "early_stop"}
    expected = blended.reference_gradients(**of_points, spread_weight=2.0)
    assert np.array_equal(gradients["features"], without["features"])
    assert relative_error(gradients["opacity"], expected[1]) < 2e-5
    assert relative_error(without["opacity"], expected[1]) > 0.01 or n == 1


def test_gradients_of_the_spread_against_finite_differences(dev, rng):
    blended = alpha_scene(dev, rng, n=60)
    blended.grad[:] = 0

    def loss(opacity):
        return oracle.spread(blended.geometry, oracle.alpha(blended.geometry, opacity)).sum()

    numeric = numeric_gradient(loss, blended.opacity.astype(np.float64), 1e-5, np.arange(60))
    assert np.abs(numeric).max() > 0.1
    gradients = blended.gradients(spread_weight=1.0)
    assert relative_error(gradients["opacity"], numeric) < 1e-5


def test_a_spread_that_begins_at_0_takes_no_program_of_its_own(dev, rng, monkeypatch):
    monkeypatch.setattr(dev, "_programs", {})
    blended = alpha_scene(dev, rng)
    blended.gradients()
    built = set(dev._programs)
    blended.gradients(spread_weight=1.0)
    assert set(dev._programs) == built


def test_hits_at_one_depth_and_single_hits_have_no_spread(dev):
    for z in ([0.5], [0.5] * 7):
        scene, _ = on_axis(dev, z, [0.5] * len(z), 0.1, rule="alpha")
        gradients = scene.gradients(np.zeros((1, 1, 16)), spread_weight=1e6)
        assert (gradients["opacity"] == 0).all()


def test_a_softmax_has_no_spread(dev, rng):
    with pytest.raises(ValueError, match="spread"):
        Blended(dev, rng).gradients(spread_weight=1.0)


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("size", [(1, 1), (31, 33)])
def test_sizes(dev, rng, n, size):
    blended = alpha_scene(dev, rng, n=n, size=size, early_stop=1e-3)
    expected = oracle.features(blended.blend, blended.point_features)
    assert relative_error(blended.features, expected) < 2e-5
    gradients, expected = blended.gradients(), blended.reference_gradients()
    assert relative_error(gradients["features"], expected[0]) < 2e-5
    assert relative_error(gradients["opacity"], expected[1]) < 2e-5


def test_gradients_against_finite_differences(dev, rng):
    """Opacities of 0 and 1 included: the blend is a polynomial of them."""
    blended = alpha_scene(dev, rng, n=60)
    gradients = blended.gradients()

    def loss(opacity, point_features):
        blend = oracle.alpha(blended.geometry, opacity)
        return (oracle.features(blend, point_features) * blended.grad).sum()

    opacity = blended.opacity.astype(np.float64)
    numeric = numeric_gradient(
        lambda o: loss(o, blended.point_features), opacity, 1e-5, np.arange(60)
    )
    assert relative_error(gradients["opacity"], numeric) < 1e-5
    assert np.abs(numeric[(opacity == 0) | (opacity == 1)]).max() > 0.1
    some = rng.choice(60 * 16, 50, replace=False)
    numeric = numeric_gradient(lambda f: loss(opacity, f), blended.point_features, 1e-4, some)
    assert relative_error(gradients["features"].ravel()[some], numeric) < 1e-5


@pytest.mark.parametrize("mean", [False, True])
def test_sphere_gradients_against_finite_differences(dev, rng, mean):
    n, step = 30, 1e-6
    blended = alpha_scene(dev, rng, n=n, kind="sphere", mean=mean)
    hit, gradients = blended.scene.hits(), blended.scene.sphere_gradients(blended.grad)
    ranks = oracle.order(blended.geometry)

    def loss(positions, radius):
        geometry = oracle.geometry(blended.camera, positions, radius, "sphere") | {"hit": hit}
        assert np.array_equal(oracle.order(geometry)[hit], ranks[hit])
        blend = oracle.alpha(geometry, blended.opacity)
        return (oracle.features(blend, blended.point_features) * blended.grad).sum()

    scale = np.maximum(hit.sum(axis=1), 1) if mean else np.ones(n)
    radius = blended.radius.astype(np.float64)
    numeric = (
        numeric_gradient(lambda p: loss(p, radius), blended.positions, step).reshape(n, 3)
        / scale[:, None]
    )
    assert relative_error(gradients["positions"], numeric) < 2e-3
    numeric = numeric_gradient(lambda r: loss(blended.positions, r), radius, step) / scale
    assert relative_error(gradients["radius"], numeric) < 2e-3


# ---- what is dropped


@pytest.mark.parametrize("option", ["early_stop", "tau"])
@pytest.mark.parametrize("least", STOPS)
def test_drops(dev, rng, option, least):
    """Nothing in front of the stop is dropped, all behind it is; the weight it would have had is at
    most what is said, and that is at most `least`.
    """
    options = {"n": 500, "radius": 0.4}
    blended = alpha_scene(dev, rng, **options, **{option: least})
    hit, kept = blended.geometry["hit"], blended.blend["hit"]
    dropped = hit & ~kept
    assert dropped.sum() > 100 and np.array_equal(dropped, hit & (blended.role == DROPPED))
    expected = oracle.features(blended.blend, blended.point_features)
    assert relative_error(blended.features, expected) < 2e-5

    scene = blended.scene
    said = scene.weighing.dropped(scene.pairs, scene.weights).get()
    whole = oracle.alpha(blended.geometry, blended.opacity)
    missing = np.where(dropped, whole["weight"], 0).sum(axis=0)
    assert (said < least).all() and (missing <= said * (1 + 1e-5)).all()
    values = np.vstack([blended.point_features, np.ones(16)])  # the background's are 1
    exact = oracle.features(whole, blended.point_features)
    bound = said[:, None] * np.ptp(values, axis=0)
    assert (np.abs(blended.features - exact) <= bound + 1e-5).all()
    shaded = blended.scene.weights.shaded.get()
    np.testing.assert_array_equal(shaded, np.flatnonzero(kept.any(axis=1)))


# ---- hard cases


def test_an_opaque_hit_hides_all_behind_it(dev):
    """alpha = 1: no weight behind it, no division by 1 - alpha, and a gradient by which it can fade
    again.
    """
    scene, weight = blend_on_axis(dev, [0.5, 1.0, 1.0, 0.3])
    assert np.allclose(weight, [0.5, 0.5, 0, 0], atol=1e-7)
    gradients = scene.gradients(np.arange(16.0).reshape(1, 1, 16))
    assert np.allclose(gradients["opacity"], [-1, -0.5, 0, 0], atol=1e-5)


@pytest.mark.parametrize("early_stop", [0.0, 1e-3])
def test_all_opacities_zero(dev, early_stop):
    """The picture is the background, and yet every opacity has a gradient by which it can come
    back.
    """
    scene, weight = blend_on_axis(dev, [0.0, 0.0, 0.0], early_stop=early_stop)
    assert (weight == 0).all() and (scene.features.get() == 1).all()
    gradients = scene.gradients(np.ones((1, 1, 16)))
    assert np.allclose(gradients["opacity"], 1 - 16)
    assert (gradients["features"] == 0).all()


def test_equal_depths_are_ordered_by_index(dev):
    scene, weight = on_axis(dev, [0.7] * 5, [0.5] * 5, 0.1, rule="alpha", max_tracked=2)
    assert np.allclose(weight, 0.5 ** np.arange(1, 6))
    gradients = scene.gradients(np.ones((1, 1, 16)))
    assert (gradients["features"].any(axis=1)).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("least", [0.0, 1e-3])
def test_thousands_of_hits_until_the_transmittance_underflows(dev, rng, least):
    z, opacity = rng.uniform(0.1, 0.99, 20_000), np.float32(rng.uniform(0, 1, 20_000))
    scene, weight = on_axis(dev, z, opacity, 0.1, rule="alpha", early_stop=least)
    order = np.argsort(-z)
    through = np.concatenate([[1], np.cumprod(1 - opacity[order].astype(np.float64))[:-1]])
    expected = np.zeros(len(z))
    expected[order] = np.where(through >= least, through * opacity[order], 0)
    assert np.allclose(weight, expected, rtol=1e-4, atol=1e-30) and through[-1] < 1e-300
    gradients = scene.gradients(rng.normal(size=(1, 1, 16)))
    assert all(np.isfinite(g).all() for g in gradients.values())
    assert np.abs(gradients["opacity"]).max() > 0.1


def test_faint_hits_add_up(dev):
    """A thousand hits of 1e-3 let exp(-1) through, to float32's accuracy."""
    scene, weight = blend_on_axis(dev, np.full(1000, 1e-3))
    assert abs(1 - weight.sum() - (1 - 1e-3) ** 1000) < 1e-5
    gradient = scene.gradients(np.ones((1, 1, 16)))["opacity"]
    assert np.isfinite(gradient).all() and (gradient < 0).all()


def test_an_empty_view(dev):
    camera = make_camera(31, 33)
    scene = PairedPoints(dev, camera, np.array([[100.0, 0, 3.0], [0, 0, 300.0]]), 0.01)
    assert (scene.blend([1, 1], 0.1, np.zeros((2, 16)), rule="alpha", early_stop=1e-3) == 1).all()
    gradients = scene.gradients(np.ones((33, 31, 16)))
    assert not gradients["features"].any() and not gradients["opacity"].any()
