"""cl/training/prune.cl against numpy indexing."""

import numpy as np
import pytest
from support.guarded import AWKWARD_SIZES

from pp_cl.config import TrainConfig
from pp_cl.device.buffers import table_bytes
from pp_cl.model import PointCloud
from pp_cl.training.point_state import PointState
from pp_cl.training.prune import compact_rows, keep_indices


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


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("shape", [(), (1,), (16,), (3, 16), (2, 16), (7,)])
@pytest.mark.parametrize("pieces", [1, 3, 1000])
def test_compact(dev, rng, monkeypatch, n, shape, pieces):
    """As a new array, in place by a few pieces, and in place row by row."""
    source = rng.standard_normal((n, *shape)).astype(np.float32)
    indices = np.flatnonzero(rng.random(n) < 0.6).astype(np.uint32)
    if not indices.size:
        indices = np.zeros(1, np.uint32)
    scratch_bytes = 4 * int(np.prod(shape)) * -(-len(indices) // pieces)
    monkeypatch.setattr("pp_cl.training.prune.SCRATCH_BYTES", scratch_bytes)
    before, array = dev.bytes, dev.upload(source)
    rows = compact_rows(dev, array, dev.upload(indices))
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(rows.get(), source[indices])
    in_place = pieces > 1 and len(indices) > 1
    assert (rows.base_data is array.base_data) == in_place
    del array
    assert dev.bytes == before + (source.nbytes if in_place else rows.nbytes)
    again = compact_rows(dev, rows, dev.upload(np.zeros(1, np.uint32)))
    del rows
    np.testing.assert_array_equal(again.get(), source[indices[:1]])
    assert dev.bytes == before + again.nbytes


@pytest.mark.parametrize("dtype", [np.uint32, np.float32, np.float16])
@pytest.mark.parametrize("scratch_bytes", [1, 2**20])
def test_compact_keeps_every_bit(dev, monkeypatch, dtype, scratch_bytes):
    monkeypatch.setattr("pp_cl.training.prune.SCRATCH_BYTES", scratch_bytes)
    bits = np.array([0, 0x7FC00001, 0xFFFFFFFF, 1, 0x80000000, 0x7FF87C01], np.uint32)[:, None]
    indices = dev.upload(np.array([1, 2, 4, 5], np.uint32))
    rows = compact_rows(dev, dev.upload(bits.view(dtype)), indices)
    np.testing.assert_array_equal(rows.get().view(np.uint32), bits[[1, 2, 4, 5]])


@pytest.mark.parametrize("share", [2, 10])
@pytest.mark.parametrize("settings", [{}, {"lazy_adam": True, "moments_16bit": True}])
def test_compacting_never_takes_more_than_its_scratch(dev, rng, monkeypatch, share, settings):
    """Every row of the cloud and of its training state, averages included."""
    scratch = 40_000
    monkeypatch.setattr("pp_cl.training.prune.SCRATCH_BYTES", scratch)
    cloud = PointCloud.create(dev, np.arange(1000), 2)
    for array in cloud.learned().values():
        array.set(rng.random(array.shape).astype(np.float32))
    del array  # else it is not released
    state = PointState(dev, cloud, TrainConfig(**settings))
    state.ema.update(cloud.learned(), 1.0)
    state.weight_sum.set(rng.random(1000).astype(np.float32))
    state.restore(
        cloud,
        {k: (1e3 * rng.random(a.shape)).astype(a.dtype) for k, a in state.arrays().items()},
    )
    host = cloud.arrays() | state.arrays()
    assert len(host) == 5 + 1 + 2 + 5 + (1 + 4 if settings else 8)
    keep = np.arange(0, 1000, share, dtype=np.uint32)
    indices = dev.upload(keep)
    before, dev.peak_bytes = dev.bytes, dev.bytes
    cloud.compact(dev, indices)
    state.compact(dev, indices)
    found = cloud.arrays() | state.arrays()
    for name, values in host.items():
        np.testing.assert_array_equal(found[name], values[keep])
    assert cloud.count == len(keep)
    assert dev.peak_bytes <= before + scratch
    old, new = (
        PointCloud.table(n, cloud.blocks)
        | PointState.table(n, cloud.blocks, TrainConfig(**settings))
        | {f"ema.{name}": row for name, row in PointState.ema_table(n, cloud.blocks).items()}
        for n in (1000, cloud.count)
    )
    small = [name for name in new if table_bytes({name: new[name]}) <= scratch]
    assert before - dev.bytes == sum(
        table_bytes({name: old[name]}) - table_bytes({name: new[name]}) for name in small
    )
