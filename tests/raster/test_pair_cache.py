"""The cache of pairs: the same bits as pairs built anew, within the budget, cleared when the points
change.
"""

import numpy as np
import pytest
from support.models import make_model
from support.scenes import ring_cameras

from pp_cl.raster.pair_cache import ARRAYS, PairCache
from pp_cl.raster.pairs import PairBuilder
from pp_cl.raster.project import Footprint
from pp_cl.render import Renderer
from pp_cl.selftest.points import PairedPoints, make_camera, make_points
from pp_cl.settings import RasterConfig

pytestmark = pytest.mark.kernels

GAMMA = 0.03


def state(pairs):
    """Host copies of Pairs; without pairs, their arrays hold one row that means nothing."""
    arrays = {name: getattr(pairs, name).get() for name in ARRAYS}
    rows = [
        array[: pairs.total] if name.startswith("pair_") else array
        for name, array in arrays.items()
    ]
    return [pairs.total, *rows]


def build(cache, key, scene, builder):
    """The state of a scene's pairs, built through the cache."""
    pairs = cache.get(key) or builder.build(scene.projected, scene.shape)
    cache.keep(key, pairs)
    return state(pairs)


def same(first, second):
    """Whether two states are the same bits."""
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("budget", [0, 30_000, 10**9])
def test_kept_hits_are_the_same_bits(dev, rng, budget):
    """Views of different sizes in changing order, one of them empty."""
    sizes = [(24, 20), (31, 33), (1, 1), (24, 20), (16, 8)]
    scenes = [
        PairedPoints(dev, make_camera(*size), make_points(rng, 257) + 1e6 * (i == 4), 0.2)
        for i, size in enumerate(sizes)
    ]
    expected = [state(scene.pairs) for scene in scenes]
    assert expected[4][0] == 0 < expected[0][0]
    cache, builder = PairCache(dev, budget), PairBuilder(dev, Footprint("soft"))
    for turn in range(3):
        for i in np.random.default_rng(turn).permutation(5):
            assert same(build(cache, int(i), scenes[i], builder), expected[i])
        assert len(cache) == 5 if budget == 10**9 else len(cache) < 5
        assert cache.bytes <= budget
    assert (len(cache) > 0) == (budget > 0)


def test_a_kept_view_is_not_built_again(dev, rng):
    scene, other = (PairedPoints(dev, make_camera(), make_points(rng, 60), 0.2) for _ in range(2))
    cache, builder = PairCache(dev, 10**9), PairBuilder(dev, Footprint("soft"))
    first = build(cache, "a", scene, builder)
    assert not same(build(cache, None, other, builder), first) and len(cache) == 1
    assert same(build(cache, "a", other, builder), first)
    cache.clear()
    assert cache.bytes == 0 and not same(build(cache, "a", other, builder), first)


@pytest.mark.parametrize("footprint", ["soft", "disc"])
@pytest.mark.parametrize("tau", [0.0, 1e-3])
def test_pictures_and_gradients_are_the_same_bits(dev, rng, footprint, tau):
    """With opacities that change from step to step, and points that go."""
    model, cameras = make_model(dev, rng), ring_cameras(3, 24)
    settings = RasterConfig(
        footprint=footprint, radius=0.75 if footprint == "soft" else 0.0015, tau=tau
    )
    kept = Renderer(dev, model, settings, cache_bytes=10**9)
    anew = Renderer(dev, model, settings)
    grad = dev.upload(rng.normal(size=(24, 24, 16)), np.float32)
    for step in range(8):
        if step == 5:
            kept.cache.clear()
            model.cloud.compact(dev, dev.upload(np.arange(0, model.cloud.count, 2), np.uint32))
        model.cloud.opacity.set(rng.uniform(0, 1, model.cloud.count).astype(np.float32))
        results = []
        for renderer, key in ((kept, step % 3), (anew, None)):
            result = renderer.rasterise(cameras[step % 3], GAMMA, key=key)
            gradients = [g.get() for g in renderer.backward_features(result, grad)]
            peaks, looks = (dev.zeros((model.cloud.count,)) for _ in range(2))
            renderer.raise_peaks(result, peaks, looks)
            results.append([result.features.get(), peaks.get(), looks.get(), *gradients])
        assert same(*results)
    assert len(kept.cache) == 3 and len(anew.cache) == 0


def test_a_cached_view_reserves_no_room_for_pairs(dev, rng):
    """The pairs of a cached view stay where they are: the builder's buffers need not hold them."""
    scene, footprint = (
        PairedPoints(dev, make_camera(), make_points(rng, 257), 0.3),
        Footprint("soft"),
    )
    cache = PairCache(dev, 10**9)
    build(cache, "a", scene, PairBuilder(dev, footprint))
    builder, before = PairBuilder(dev, footprint), dev.bytes
    build(cache, "a", scene, builder)
    assert dev.bytes == before
