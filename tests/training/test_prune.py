"""Which points are dropped, and that all their rows go alike."""

import numpy as np
import pytest
from support.models import fetched

from pp_cl.device.buffers import table_bytes
from pp_cl.errors import Diverged
from pp_cl.raster.point_cloud import PointCloud
from pp_cl.settings import TrainConfig
from pp_cl.training.point_state import PointState
from pp_cl.training.prune import judge, keep_indices


def kept(dev, weights, least_weight, opacities, least_opacity):
    weights, opacities = (dev.upload(np.asarray(a, np.float32)) for a in (weights, opacities))
    indices = keep_indices(dev, weights, least_weight, opacities, least_opacity=least_opacity)
    assert indices.dtype == np.uint32
    return indices.get().tolist()


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
    monkeypatch.setattr("pp_cl.device.rows.SCRATCH_BYTES", scratch)
    cloud = PointCloud.create(dev, np.arange(1000), 2)
    for array in cloud.learned().values():
        array.set(rng.random(array.shape).astype(np.float32))
    del array  # else it is not released
    state = PointState(dev, cloud)
    state.ema.update(cloud.learned(), 1.0)
    state.peak_weight.set(rng.random(1000).astype(np.float32))
    state.restore(
        cloud,
        {k: (1e3 * rng.random(a.shape)).astype(a.dtype) for k, a in state.arrays().items()},
    )
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


def test_only_what_was_looked_at_is_judged(dev):
    """By the highest weight of a look, and counted anew; the rest keeps its counts."""
    settings = TrainConfig(prune_weight=0.1, prune_looks=10, prune_opacity=0.01, sh_rate=(1, 0, 0))
    cloud = PointCloud.create(dev, np.arange(6), 0)
    state = PointState(dev, cloud)
    state.peak_weight.set(np.float32([0, 0, 0.09, 0.1, 100, 0]))
    state.look_count.set(np.float32([9, 10, 10, 10, 1000, 10]))
    opacity = dev.upload(np.float32([0, 1, 1, 1, 1, 1]))
    assert judge(dev, state, opacity, settings).get().tolist() == [0, 3, 4]
    assert state.look_count.get().tolist() == [9, 0, 0, 0, 0, 0]
    assert not state.peak_weight.get().any()
    opacity.set(np.float32([0, 1, 1, 0, 1, 1]))
    state.look_count.set(np.float32([20, 9, 9, 20, 0, 0]))
    state.peak_weight.set(np.float32([5, 0, 0, 5, 0, 0]))
    assert judge(dev, state, opacity, settings).get().tolist() == [1, 2, 4, 5]


@pytest.mark.parametrize("peak, opacity", [(np.nan, 1), (np.inf, 1), (0.5, np.nan), (0.5, -np.inf)])
def test_what_is_not_finite_is_told_of_and_not_pruned_away(dev, peak, opacity):
    """Also of points that nobody has looked at."""
    settings = TrainConfig(prune_looks=10)
    cloud = PointCloud.create(dev, np.arange(2), 0)
    state = PointState(dev, cloud)
    state.peak_weight.set(np.float32([0, peak]))
    with pytest.raises(Diverged, match="^1 points have"):
        judge(dev, state, dev.upload(np.float32([1, opacity])), settings)


def test_one_judged_point_always_survives(dev):
    settings = TrainConfig(prune_looks=1, prune_weight=1.0)
    cloud = PointCloud.create(dev, np.arange(3), 2)
    state = PointState(dev, cloud)
    state.peak_weight.set(np.float32([0.1, 0.3, 0.2]))
    state.look_count.set(np.float32([10, 10, 10]))
    assert judge(dev, state, cloud.opacity, settings).get().tolist() == [1]
