import numpy as np
import pytest
from support.models import fetched, make_model

from pp_cl.config import configure, preset
from pp_cl.engine.grid import Grid
from pp_cl.engine.raster.points import PointCloud
from pp_cl.engine.stored import cloud_arrays, state_arrays
from pp_cl.engine.training.between import refine
from pp_cl.engine.training.prune import final_points_to_keep, points_to_keep
from pp_cl.engine.training.state import PointState
from pp_cl.errors import Diverged
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.training import open_training
from pp_cl.settings import TrainConfig

pytestmark = pytest.mark.kernels  # they test refine.cl


def rows(opacity):
    """(N, 9) float32 coefficients of opacities that are the same from all sides."""
    return np.pad(np.float32(opacity)[:, None], ((0, 0), (0, 8)))


def survivors(dev, weights, least_weight, opacities, seen=None, least=1):
    settings = TrainConfig(prune_weight=least_weight)
    arrays = weights, seen or [1] * len(weights), rows(opacities)
    arrays = (dev.upload(np.asarray(a, np.float32)) for a in arrays)
    indices = final_points_to_keep(dev, *arrays, settings, least)
    assert indices.dtype == np.uint32
    return indices.get().tolist()


def test_keep_needs_weight_and_opacity(dev):
    assert survivors(dev, [1, 0, 1, 0.5, 2], 0.5, [1, 1, 0.009, 0.01, 0.6]) == [0, 3, 4]
    assert survivors(dev, [1, 0, 1], 0, [1, 1, 0]) == [0, 1]
    assert survivors(dev, [np.nan, 1, 1], 0, [1, 1, np.nan]) == [1]
    assert survivors(dev, [1, 1, 1], 0.5, [1, 1, 1], seen=[1, 2, 0], least=2) == [1]


@pytest.mark.parametrize(
    ("weights", "survivor"),
    [([1, 3, 2], 1), ([0, 0, 0], 0), ([np.nan, 1, 2], 2), ([np.nan] * 3, 0)],
)
def test_one_point_always_survives(dev, weights, survivor):
    assert survivors(dev, weights, 5, [0, 0, 0]) == [survivor]


def test_only_what_was_seen_is_judged(dev):
    settings = TrainConfig(prune_weight=0.1, sh_rate=(1, 0, 0))
    cloud = PointCloud.create(dev, np.arange(6), 0)
    state = PointState(dev, cloud)
    state.max_weight.set(np.float32([0, 0, 0.09, 0.1, 100, 0]))
    state.times_seen.set(np.float32([99, 100, 100, 100, 1000, 100]))
    opacity = dev.upload(rows([0, 1, 1, 0.01, 1, 1]))
    assert points_to_keep(dev, state, opacity, settings).get().tolist() == [0, 3, 4]
    assert state.times_seen.get().tolist() == [99, 0, 0, 0, 0, 0]
    weights = state.max_weight.get()
    assert (weights < np.float32(0.1)).all(), "those that are kept must reach it again"
    opacity.set(rows([0, 1, 1, 0, 1, 1]))
    state.times_seen.set(np.float32([200, 99, 99, 200, 0, 0]))
    state.max_weight.set(np.float32([5, 0, 0, 5, 0, 0]))
    assert points_to_keep(dev, state, opacity, settings).get().tolist() == [1, 2, 4, 5]
    state.times_seen.set(np.float32([100] * 6))
    state.max_weight.set(np.float32([0.01, 0.03, 0.02, 0, 0, 0]))
    assert points_to_keep(dev, state, opacity, settings).get().tolist() == [1], "one always is"


@pytest.mark.parametrize("peak, opacity", [(np.nan, 1), (np.inf, 1), (0.5, np.nan), (0.5, -np.inf)])
def test_what_is_not_finite_is_told_of_and_not_pruned_away(dev, peak, opacity):
    cloud = PointCloud.create(dev, np.arange(2), 0)
    state = PointState(dev, cloud)
    state.max_weight.set(np.float32([0, peak]))
    with pytest.raises(Diverged, match="^1 points have"):
        points_to_keep(dev, state, dev.upload(rows([1, opacity])), TrainConfig())


def test_children_are_centred_on_their_parent():
    grid = Grid((0.3, -1.0, 2.0), 0.5, (3, 4, 5))
    ids = np.sort(grid.ids(np.array([(0, 0, 0), (1, 2, 0), (0, 2, 2), (2, 3, 4)])))
    children, parents = grid.children(ids)
    assert (np.diff(children.astype(np.int64)) > 0).all()
    assert np.bincount(parents).tolist() == [8] * 4
    offsets = grid.refined().positions(children) - grid.positions(ids[parents])
    assert np.allclose(np.abs(offsets), 0.125)
    assert len(np.unique(np.column_stack([parents, offsets > 0]), axis=0)) == 32


def test_a_grid_beyond_32_bits_is_refused():
    with pytest.raises(ValueError, match="cannot be refined"):
        Grid((0, 0, 0), 1.0, (1024, 1024, 513)).children(np.array([0]))


def test_the_state_follows(dev, rng):
    model = make_model(dev, rng)
    state = PointState(dev, model.cloud)
    averages = PointState.ema_table(model.cloud.count)
    state.averages |= {name: dev.empty(*row) for name, row in averages.items()}
    for array in state_arrays(state).values():
        array.set((1e3 * rng.random(array.shape)).astype(array.dtype))
    grid, before = model.grid, fetched(cloud_arrays(dev, model.cloud) | state_arrays(state))
    ids, parents = grid.children(before["points.ids"])
    state.refine(dev, model.refine())

    after = fetched(cloud_arrays(dev, model.cloud) | state_arrays(state))
    assert model.grid == grid.refined() and after.keys() == before.keys()
    np.testing.assert_array_equal(model.grid_buffer.get(), grid.refined().packed(grid.centre))
    np.testing.assert_array_equal(after.pop("points.ids"), ids)
    assert not after.pop("state.max_weight").any() and not after.pop("state.times_seen").any()
    for name, array in after.items():
        np.testing.assert_array_equal(array, before[name][parents])


@pytest.mark.parametrize("blend", ["alpha", "softmax"])
def test_refined_points_let_as_much_light_through(dev, scene, tmp_path, blend):
    settings = {"points.count": 300, "raster.blend": blend, "train.refine_at": "0.5,1"}
    settings["scene.downscale"] = 1
    config = configure(preset("tiny"), scene, [(k, v, "test") for k, v in settings.items()])
    trainer = open_training(dev, RunFolder(tmp_path / "run"), config, None).trainer
    trainer.optimiser.update_ema(1.0)
    opacities = trainer.model.cloud, trainer.state.averages
    before = opacities[0].opacity.get(), opacities[1]["opacity"].get()
    refine(trainer)
    for old, new in zip(before, (opacities[0].opacity, opacities[1]["opacity"]), strict=True):
        expected = old[0] / (1 + np.sqrt(1 - old[0, 0])) if blend == "alpha" else old[0]
        np.testing.assert_allclose(new.get(), np.tile(expected, (len(new), 1)), rtol=1e-5)
