"""Cases of the blend by alpha compositing: weights, features, gradients, opacities of 0 and 1, and
a transmittance that underflows.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np

from pp_cl.device.device import Device
from pp_cl.raster.project import FOOTPRINTS
from pp_cl.raster.weights import DROPPED
from pp_cl.reference import dense
from pp_cl.selftest.case import (
    SIZES,
    Case,
    Check,
    absolute,
    each,
    exact,
    finite,
    no_more,
    relative,
)
from pp_cl.selftest.points import Blended, blend_on_axis

# a closeness is off by 1e-6, as the places are (project); the product of some ten 1 - alpha of them
# by as many times that
WEIGHT = 1e-5
GRADIENT = 2 * WEIGHT  # T, and what is composited behind, each with that error


def _forward(kind: str, dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    for n in SIZES:
        blended = Blended(dev, rng, n, kind=kind, rule="alpha")
        yield absolute(blended.weight, blended.blend["weight"], WEIGHT)
        expected = dense.features(blended.blend, blended.point_features)
        yield relative(blended.features, expected, WEIGHT)
        empty = ~blended.geometry["hit"].any(axis=0)
        yield exact(blended.features[empty], np.ones((empty.sum(), 16)))
        yield exact(blended.scene.weights.shaded.get(), blended.scene.seen)
        transmittance = blended.scene.weights.transmittance.get()
        yield absolute(transmittance, blended.blend["background"], WEIGHT)


def _backward(kind: str, dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    for mean, tracked in ((False, 0), (False, 3), (True, 0)):
        options = {"mean": mean, "max_tracked": tracked, "rule": "alpha"}
        blended = Blended(dev, rng, kind=kind, **options)
        gradients, expected = blended.gradients(), blended.reference_gradients(tracked, mean)
        yield relative(gradients["features"], expected[0], GRADIENT)
        yield relative(gradients["opacity"], expected[1], GRADIENT)
        unseen = ~blended.blend["hit"].any(axis=1)
        yield exact(gradients["opacity"][unseen], np.zeros(unseen.sum()))


def _sizes(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    for n in SIZES:
        for size in ((1, 1), (31, 33)):
            blended = Blended(dev, rng, n, size=size, rule="alpha", early_stop=1e-3)
            expected = dense.features(blended.blend, blended.point_features)
            yield relative(blended.features, expected, GRADIENT)
            gradients, expected = blended.gradients(), blended.reference_gradients()
            yield relative(gradients["features"], expected[0], GRADIENT)
            yield relative(gradients["opacity"], expected[1], GRADIENT)


def _gradient_of_alpha(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """One of alpha is one of a feature that is 0 in all points, since the background's is 1."""
    for options in ({"early_stop": 0.0}, {"early_stop": 0.05}):
        blended = Blended(dev, rng, rule="alpha", **options)
        grad_alpha = rng.normal(size=len(blended.grad))
        blended.point_features[:, 15] = 0
        features = blended.point_features
        blended.scene.blend(blended.opacity, 0.1, features, rule="alpha", **options)
        blended.grad[:, 15] = -grad_alpha
        expected = blended.reference_gradients()
        blended.grad[:, 15] = 0
        gradients = blended.scene.gradients(blended.grad, grad_alpha)
        yield relative(gradients["opacity"], expected[1], GRADIENT)
        yield relative(gradients["features"][:, :15], expected[0][:, :15], GRADIENT)


def _spread(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Of hits of all weights, of those before an early stop, and of the tracked ones."""
    for n, tracked, stop, mean in (
        (257, 0, 0.0, False),
        (257, 0, 0.05, False),
        (257, 3, 0.0, False),
        (33, 0, 0.0, True),
        (31, 0, 0.0, False),
    ):
        options = {"max_tracked": tracked, "early_stop": stop, "mean": mean}
        blended = Blended(dev, rng, n, rule="alpha", **options)
        blended.grad[:] = 0
        expected = blended.reference_gradients(tracked, mean, spread_weight=3.0)[1]
        gradients = blended.gradients(spread_weight=3.0)
        yield relative(gradients["opacity"], expected, GRADIENT)
        yield exact(gradients["features"], np.zeros((n, 16)))


def _drops(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Nothing in front of the stop is dropped, all behind it is."""
    for least in (1e-3, 0.05, 0.5):
        blended = Blended(dev, rng, 500, radius=0.4, rule="alpha", early_stop=least)
        hit, scene = blended.geometry["hit"], blended.scene
        dropped = hit & ~blended.blend["hit"]
        yield exact(hit & (blended.role == DROPPED), dropped)
        yield exact(scene.weights.shaded.get(), np.flatnonzero((hit & ~dropped).any(axis=1)))
        expected = dense.features(blended.blend, blended.point_features)
        yield relative(blended.features, expected, GRADIENT)
        whole = dense.alpha(blended.geometry, blended.opacity)["weight"]
        weighed = np.where(dropped, whole, 0).sum(axis=0)
        yield no_more(weighed, np.full_like(weighed, least), 0.0)


def _opaque(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """alpha = 1: no weight behind it, no division by 1 - alpha, a gradient by which it can fade."""
    scene, weight = _on_axis(dev, [0.5, 1.0, 1.0, 0.3])
    yield absolute(weight, [0.5, 0.5, 0, 0], 1e-7)  # a rounding
    gradients = scene.gradients(np.arange(16.0).reshape(1, 1, 16))
    yield absolute(gradients["opacity"], [-1, -0.5, 0, 0], WEIGHT)


def _on_axis(dev, opacity, **options):
    """Hits one behind another in a single pixel."""
    z = np.linspace(0.9, 0.1, len(opacity))
    return blend_on_axis(dev, z, opacity, 0.1, rule="alpha", **options)


def _zero_opacity(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """The picture is the background; every opacity has a gradient by which it can come back."""
    for stop in (0.0, 1e-3):
        scene, weight = _on_axis(dev, [0.0, 0.0, 0.0], early_stop=stop)
        yield exact(weight, np.zeros(3))
        yield exact(scene.features.get(), np.ones((1, 1, 16)))
        gradients = scene.gradients(np.ones((1, 1, 16)))
        yield each(gradients["opacity"], np.full(3, 1 - 16), WEIGHT)
        yield exact(gradients["features"], np.zeros((3, 16)))


def _equal_depths(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """Ordered, and tracked, by index."""
    for count in (5, 17, 100):
        given = [0.7] * count, [0.5] * count
        scene, weight = blend_on_axis(dev, *given, 0.1, rule="alpha", max_tracked=2)
        yield each(weight, 0.5 ** np.arange(1, count + 1), WEIGHT)
        tracked = scene.gradients(np.ones((1, 1, 16)))["features"].any(axis=1)
        yield exact(tracked, np.arange(count) < 2)


def _underflow(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """20000 hits: the transmittance falls below the smallest number, with nothing not finite."""
    z, opacity = rng.uniform(0.1, 0.99, 20_000), np.float32(rng.uniform(0, 1, 20_000))
    order = np.argsort(-z)
    through = np.concatenate([[1], np.cumprod(1 - opacity[order].astype(np.float64))[:-1]])
    for least in (0.0, 1e-3):
        scene, weight = blend_on_axis(dev, z, opacity, 0.1, rule="alpha", early_stop=least)
        expected = np.zeros(len(z))
        expected[order] = np.where(through >= least, through * opacity[order], 0)
        # down to 1e-30, some hundred factors of half EPS each
        yield each(weight, expected, 1e-4, floor=1e-26)
        yield finite(*scene.gradients(rng.normal(size=(1, 1, 16))).values())


def _faint(dev: Device, rng: np.random.Generator) -> Iterator[Check]:
    """A thousand hits of 1e-3 let exp(-1) through: a thousand roundings that mostly cancel."""
    scene, weight = _on_axis(dev, np.full(1000, 1e-3))
    yield absolute(1 - weight.sum(), (1 - 1e-3) ** 1000, 1e-5)
    gradient = scene.gradients(np.ones((1, 1, 16)))["opacity"]
    yield exact(gradient < 0, np.ones(1000, bool))


CASES = (
    *(Case(f"alpha: forward, {kind}", partial(_forward, kind)) for kind in FOOTPRINTS),
    *(Case(f"alpha: backward, {kind}", partial(_backward, kind)) for kind in FOOTPRINTS),
    Case("alpha: awkward sizes", _sizes),
    Case("alpha: gradient of alpha", _gradient_of_alpha),
    Case("alpha: spread", _spread),
    Case("alpha: early stop", _drops),
    Case("alpha: opacities of 1", _opaque),
    Case("alpha: opacities of 0", _zero_opacity),
    Case("alpha: equal depths", _equal_depths),
    Case("alpha: transmittance that underflows", _underflow),
    Case("alpha: faint hits", _faint),
)
