"""Refining the grid: where the new points are, what they take over, how much they hide."""

import numpy as np
import pytest
from support.models import fetched, make_model

from pp_cl.config import configure, preset
from pp_cl.files.run_folder import RunFolder
from pp_cl.scene.grid import Grid
from pp_cl.session import open_training
from pp_cl.training.state import PointState


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


def test_the_state_follows(dev, rng):
    """Each point's rows, averages among them; weights and looks start anew."""
    model = make_model(dev, rng)
    state = PointState(dev, model.cloud)
    learned = model.cloud.learned().items()
    state.averages |= {name: dev.empty(array.shape) for name, array in learned}
    for array in state.arrays().values():
        array.set((99 * rng.random(array.shape)).astype(array.dtype))
    grid, before = model.grid, fetched(model.cloud.arrays(dev) | state.arrays())
    ids, parents = grid.children(before["points.ids"])
    state.refine(dev, model.refine())

    after = fetched(model.cloud.arrays(dev) | state.arrays())
    assert model.grid == grid.refined() and after.keys() == before.keys()
    np.testing.assert_array_equal(model.grid_buffer.get(), grid.refined().packed(grid.centre))
    np.testing.assert_array_equal(after.pop("points.ids"), ids)
    assert not after.pop("state.max_weight").any() and not after.pop("state.times_seen").any()
    for name, array in after.items():
        np.testing.assert_array_equal(array, before[name][parents])


@pytest.mark.parametrize("blend", ["alpha", "softmax"])
def test_refined_points_let_as_much_light_through(dev, scene, tmp_path, blend):
    """Two behind one another what one did, in alpha compositing; averages among them."""
    given = {"points.count": 300, "raster.blend": blend, "train.refine_at": "0.5,1"}
    given["scene.downscale"] = 1
    config = configure(preset("tiny"), scene, [(k, v, "test") for k, v in given.items()])
    trainer = open_training(dev, RunFolder(tmp_path / "run"), config, None).trainer
    trainer.optimiser.update_ema(1.0)
    opacities = trainer.model.cloud, trainer.state.averages
    before = opacities[0].opacity.get(), opacities[1]["opacity"].get()
    trainer._refine()
    for old, new in zip(before, (opacities[0].opacity, opacities[1]["opacity"]), strict=True):
        expected = 1 - np.sqrt(1 - old[0]) if blend == "alpha" else old[0]
        np.testing.assert_allclose(new.get(), expected, rtol=1e-5)
