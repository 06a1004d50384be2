"""Refining the grid: where the new points are, what they take over, how much they hide."""

import numpy as np
import pytest
from pp_cl.training.refine import refine, split_opacity
from support.guarded import AWKWARD_SIZES
from support.models import fetched, make_model

from pp_cl.scene.grid import Grid
from pp_cl.training.state import PointState


@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_split_opacity(dev, rng, n):
    """Two points let through what one did; small opacities halve to float32's accuracy."""
    opacity = np.float32(rng.uniform(0, 1, n))
    opacity[::5], opacity[1::5], opacity[2::5] = 0, 1, 1e-7
    array = dev.upload(opacity)
    split_opacity(dev, array)
    exact = opacity.astype(np.float64) / (1 + np.sqrt(1 - opacity.astype(np.float64)))
    np.testing.assert_allclose(array.get(), exact, rtol=3e-7)
    assert np.allclose((1 - exact) ** 2, 1 - opacity)


def test_children_are_centred_on_their_parent():
    grid = Grid((0.3, -1.0, 2.0), 0.5, (3, 4, 5))
    ids = np.array([0, 7, 30, 59], np.uint32)
    children, parents = grid.children(ids)
    assert (np.diff(children.astype(np.int64)) > 0).all()
    assert np.bincount(parents).tolist() == [8] * 4
    offsets = grid.refined().positions(children) - grid.positions(ids[parents])
    assert np.allclose(np.abs(offsets), 0.125)
    assert len(np.unique(np.column_stack([parents, offsets > 0]), axis=0)) == 32


def test_a_grid_beyond_32_bits_is_refused():
    with pytest.raises(ValueError, match="cannot be refined"):
        Grid((0, 0, 0), 1.0, (1024, 1024, 513)).children(np.array([0]))


@pytest.mark.parametrize("composited", [False, True])
def test_all_arrays_follow(dev, rng, composited):
    model = make_model(dev, rng)
    state = PointState(dev, model.cloud)
    state.ema.update(model.cloud.learned(), 1.0)
    stored = state.arrays()
    state.restore(
        model.cloud, {k: (99 * rng.random(a.shape)).astype(a.dtype) for k, a in stored.items()}
    )
    state.ema.arrays["opacity"].set(rng.random(model.cloud.count).astype(np.float32))
    grid, before = model.grid, fetched(model.cloud.arrays(dev) | state.arrays())
    ids, parents = grid.children(before["points.ids"])
    refine(dev, model, state, composited=composited)

    after = fetched(model.cloud.arrays(dev) | state.arrays())
    assert model.grid == grid.refined() and after.keys() == before.keys()
    np.testing.assert_array_equal(model.grid_buffer.get(), grid.refined().packed(grid.centre))
    np.testing.assert_array_equal(after.pop("points.ids"), ids)
    assert not after.pop("state.max_weight").any() and not after.pop("state.times_seen").any()
    for name, array in after.items():
        expected = before[name][parents]
        if composited and name in ("points.opacity", "state.a.opacity"):
            expected = 1 - np.sqrt(1 - expected)
        np.testing.assert_allclose(array, expected, atol=1e-6)
