"""Which points are dropped, and that all their rows go alike."""

import numpy as np
import pytest
from support.models import fetched

from pp_cl.device.buffers import table_bytes
from pp_cl.errors import Diverged
from pp_cl.raster.points import PointCloud
from pp_cl.settings import TrainConfig
from pp_cl.training.prune import final_points_to_keep, points_to_keep
from pp_cl.training.state import PointState


def kept(dev, weights, least_weight, opacities, least_opacity):
    settings = TrainConfig(final_prune_weight=least_weight, prune_opacity=least_opacity)
    weights, opacities = (dev.upload(np.asarray(a, np.float32)) for a in (weights, opacities))
    indices = final_points_to_keep(dev, weights, opacities, settings)
    assert indices.dtype == np.uint32
    return indices.get().tolist()


def fill(state, rng):
    """Random numbers in all arrays of a point state."""
    for array in state.arrays().values():
        array.set((1e3 * rng.random(array.shape)).astype(array.dtype))


def test_keep_needs_weight_and_opacity(dev):
    assert kept(dev, [1, 0, 1, 0.5, 2], 0.5, [1, 1, 0, 0.5, 0.6], 0.5) == [0, 3, 4]
    assert kept(dev, [1, 0, 1], 0, [1, 1, 0], 0) == [0, 1, 2]
    assert kept(dev, [np.nan, 1, 1], 0, [1, 1, np.nan], 0) == [1]


@pytest.mark.parametrize(
    ("weights", "survivor"),
    [([1, 3, 2], 1), ([0, 0, 0], 0), ([np.nan, 1, 2], 2), ([np.nan] * 3, 0)],
)
def test_one_point_always_survives(dev, weights, survivor):
    assert kept(dev, weights, 5, [0, 0, 0], 0.01) == [survivor]


@pytest.mark.parametrize("share", [2, 10])
def test_compacting_never_takes_more_than_its_scratch(dev, rng, monkeypatch, share):
    """Every row of the cloud and of its training state, averages included."""
    scratch = 40_000
    monkeypatch.setattr("pp_cl.device.buffers.SCRATCH_BYTES", scratch)
    cloud = PointCloud.create(dev, np.arange(1000), 2)
    for array in cloud.learned().values():
        array.set(rng.random(array.shape).astype(np.float32))
    del array  # else it is not released
    state = PointState(dev, cloud)
    state.averages |= {name: dev.empty(array.shape) for name, array in cloud.learned().items()}
    fill(state, rng)
    host = fetched(cloud.arrays(dev) | state.arrays())
    assert len(host) == 5 + 2 + 2 + 5 + 2
    keep = np.arange(0, 1000, share, dtype=np.uint32)
    indices = dev.upload(keep)
    before, dev.peak_bytes = dev.bytes, dev.bytes
    cloud.compact(dev, indices)
    state.compact(dev, indices)
    found = fetched(cloud.arrays(dev) | state.arrays())
    for name, values in host.items():
        np.testing.assert_array_equal(found[name], values[keep])
    assert cloud.count == len(keep)
    assert dev.peak_bytes <= before + scratch
    old, new = (
        PointCloud.table(n, cloud.blocks)
        | PointState.table(n)
        | {f"ema.{name}": row for name, row in PointState.ema_table(n, cloud.blocks).items()}
        for n in (1000, cloud.count)
    )
    small = [name for name in new if table_bytes({name: new[name]}) <= scratch]
    assert before - dev.bytes == sum(
        table_bytes({name: old[name]}) - table_bytes({name: new[name]}) for name in small
    )


def test_only_what_was_seen_is_judged(dev):
    """By the highest weight in a step, and counted anew; the rest keeps its counts."""
    settings = TrainConfig(prune_weight=0.1, prune_looks=10, prune_opacity=0.01, sh_rate=(1, 0, 0))
    cloud = PointCloud.create(dev, np.arange(6), 0)
    state = PointState(dev, cloud)
    state.max_weight.set(np.float32([0, 0, 0.09, 0.1, 100, 0]))
    state.times_seen.set(np.float32([9, 10, 10, 10, 1000, 10]))
    opacity = dev.upload(np.float32([0, 1, 1, 1, 1, 1]))
    assert points_to_keep(dev, state, opacity, settings).get().tolist() == [0, 3, 4]
    assert state.times_seen.get().tolist() == [9, 0, 0, 0, 0, 0]
    assert not state.max_weight.get().any()
    opacity.set(np.float32([0, 1, 1, 0, 1, 1]))
    state.times_seen.set(np.float32([20, 9, 9, 20, 0, 0]))
    state.max_weight.set(np.float32([5, 0, 0, 5, 0, 0]))
    assert points_to_keep(dev, state, opacity, settings).get().tolist() == [1, 2, 4, 5]


@pytest.mark.parametrize("peak, opacity", [(np.nan, 1), (np.inf, 1), (0.5, np.nan), (0.5, -np.inf)])
def test_what_is_not_finite_is_told_of_and_not_pruned_away(dev, peak, opacity):
    """Also of points that nobody has seen."""
    settings = TrainConfig(prune_looks=10)
    cloud = PointCloud.create(dev, np.arange(2), 0)
    state = PointState(dev, cloud)
    state.max_weight.set(np.float32([0, peak]))
    with pytest.raises(Diverged, match="^1 points have"):
        points_to_keep(dev, state, dev.upload(np.float32([1, opacity])), settings)


def test_one_judged_point_always_survives(dev):
    settings = TrainConfig(prune_looks=1, prune_weight=1.0)
    cloud = PointCloud.create(dev, np.arange(3), 2)
    state = PointState(dev, cloud)
    state.max_weight.set(np.float32([0.1, 0.3, 0.2]))
    state.times_seen.set(np.float32([10, 10, 10]))
    assert points_to_keep(dev, state, cloud.opacity, settings).get().tolist() == [1]
