"""The memory plan against what a training really allocates, and against the paper's scale."""

import numpy as np
import pytest
from support.scenes import write_ball_scene

from pp_cl.config import Config, assign, preset
from pp_cl.errors import UserError
from pp_cl.model import Model
from pp_cl.run import open_scene
from pp_cl.scene.grid import Grid
from pp_cl.train import Trainer
from pp_cl.training.memory import memory_plan, plan_lines, point_bytes, spare_memory

PAPER_POINTS = 4_040_533  # lego, supplemental Table 4
WAYS = [
    {},
    {"train.lazy_adam": "true", "raster.early_stop": "0.001"},
    {"train.moments_16bit": "true", "train.ema": "false", "train.sh_smoothing": "0"},
]


def trained(dev, folder, changes):
    """(Trainer, its plan, peak bytes) after some steps on a ball scene with a grid full of
    points.
    """
    config = Config()
    settings = {
        "scene.path": write_ball_scene(folder),
        "scene.downscale": 2,
        "points.count": 27_000,
        "train.crop": 24,
        "network.widths": "16,16,16",
        "train.iterations": 30,
        "train.prune_every": 10,
    } | changes
    for key, value in settings.items():
        assign(config, key, value, "test")
    before, dev.peak_bytes = dev.bytes, dev.bytes
    grid = Grid((-0.87, -0.87, -0.87), 0.06, (30, 30, 30))
    model = Model.create(dev, grid, np.arange(27_000), (2.0, 6.0), config.network.widths, 0)
    views = open_scene(dev, config, ("train",)).splits["train"]
    trainer = Trainer(dev, config, model, views)
    plan = memory_plan(dev, config, model, views)
    for _ in range(30):
        trainer.train_step()
    return trainer, plan, dev.peak_bytes - before


@pytest.mark.parametrize("changes", WAYS)
def test_the_plan_is_what_a_training_takes(dev, tmp_path, changes):
    trainer, plan, peak = trained(dev, tmp_path / "ball", changes | {"train.prune_every": 1000})
    assert trainer.model.count == 27_000
    planned = {what: size for what, _, size in plan}
    pruning = planned.pop("pruning")
    assert pruning == 27_000 * 192
    assert 0.97 * peak < sum(planned.values()) < 1.03 * peak
    held = sum(array.nbytes for array in trainer.model.points.values())
    stored = ("ids, opacities, SH coefficients", "Adam's moments", "averages")
    assert held == sum(planned.get(what, 0) for what in stored) + 27_000 * (
        8 if trainer.optimiser.lazy else 4
    )


def test_pruning_stays_within_the_plan(dev, tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.training.prune.SCRATCH_BYTES", 10**6)
    trainer, plan, _ = trained(dev, tmp_path / "ball", {"train.prune_every": 1000})
    before, dev.peak_bytes = dev.bytes, dev.bytes
    trainer._prune(dev.upload(np.arange(27_000), np.float32), 1.0)
    assert trainer.model.count == 26_999
    assert dev.peak_bytes <= before + 10**6 + 2 * 4 * 27_000  # the weights and the list of the kept
    assert dev.peak_bytes <= sum(size for _, _, size in plan)


@pytest.mark.parametrize("lazy", [False, True])
def test_the_papers_scale_fits_nine_gibibytes(lazy):
    train = preset("paper").train
    train.lazy_adam = lazy
    single = PAPER_POINTS * sum(point_bytes(train, 2).values())
    # two hits a point; a disc of 0.75 pixels covers 1.77
    assert single + 2 * 45 * PAPER_POINTS < 9 * 2**30
    train.moments_16bit = True
    assert single - PAPER_POINTS * sum(point_bytes(train, 2).values()) == PAPER_POINTS * 576


def test_a_plan_over_the_memory_names_the_knobs(dev):
    rows = [("points", "(3) x 4", dev.info["memory_bytes"])]
    assert spare_memory(rows, dev, 0) == 0
    table = plan_lines(rows, dev)
    assert len(table) == 3 and "points" in table[1] and "total" in table[2]
    with pytest.raises(UserError, match="lower --points, .* train.moments_16bit"):
        spare_memory([("points", "(3) x 4", dev.info["memory_bytes"] + 1)], dev, 0)
