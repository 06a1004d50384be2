"""The memory plan against what a training really allocates."""

import gc

import numpy as np
import pytest
from support.scenes import write_ball_scene

from pp_cl.config import assign, preset
from pp_cl.device.buffers import table_bytes
from pp_cl.device.compact import compact_table
from pp_cl.errors import UserError
from pp_cl.metrics.lpips import WIDTHS, vgg_layers
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.raster.point_cloud import PointCloud
from pp_cl.scene.grid import Grid
from pp_cl.scene.open import open_scene
from pp_cl.train import Trainer
from pp_cl.training.memory import memory_plan, plan_bytes, plan_lines, spare_memory
from pp_cl.training.point_state import PointState

POINTS = 27_000
PAPER_POINTS = 4_040_533  # lego, supplemental Table 4
WAYS = [
    {},
    {"train.lazy_adam": "true", "raster.early_stop": "0.001"},
    {"train.moments_16bit": "true", "train.ema": "false", "train.sh_smoothing": "0"},
    {"points.sh_degree": "1"},
    {"train.perceptual_weight": "0.1"},
]


@pytest.fixture(autouse=True)
def nothing_left_over():
    """What earlier tests left in reference cycles is released before memory is counted."""
    gc.collect()


def trained(dev, folder, changes, base="tiny"):
    """(Trainer, its plan, peak bytes) after some steps on a ball scene with a grid full of
    points.
    """
    config = preset(base)
    settings = {
        "scene.path": write_ball_scene(folder),
        "scene.downscale": 2,
        "points.count": POINTS,
        "train.crop": 24,
        "network.widths": "16,16,16",
        "train.iterations": 30,
        "train.prune_every": 1000,
    } | changes
    for key, value in settings.items():
        assign(config, key, value, "test")
    before, dev.peak_bytes = dev.bytes, dev.bytes
    grid = Grid((-0.87, -0.87, -0.87), 0.06, (30, 30, 30))
    net = UNet(dev, widths=config.network.widths)
    degree = config.points.sh_degree
    model = Model.create(dev, grid, np.arange(POINTS), (2.0, 6.0), net=net, degree=degree)
    views = open_scene(dev, config, ("train",)).splits["train"]
    trainer = Trainer(dev, config, model, views)
    plan = memory_plan(config, model, views)
    for _ in range(30):
        trainer.train_step()
    return trainer, plan, dev.peak_bytes - before


def zero_weights():
    """Of LPIPS, in their shapes."""
    layers = vgg_layers()
    weights = {f"kernel{i}": np.zeros((x.co, x.ci, 3, 3)) for i, x in enumerate(layers)}
    weights |= {f"bias{i}": np.zeros(x.co, np.float32) for i, x in enumerate(layers)}
    return weights | {f"head{i}": np.zeros(width, np.float32) for i, width in enumerate(WIDTHS)}


@pytest.mark.parametrize("changes", WAYS)
def test_the_plan_is_what_a_training_takes(dev, tmp_path, monkeypatch, changes):
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", zero_weights)
    trainer, plan, peak = trained(dev, tmp_path / "ball", changes)
    assert trainer.model.cloud.count == POINTS
    blocks = trainer.model.cloud.blocks
    pruning = table_bytes(compact_table(POINTS, max(64 * block.count for block in blocks)))
    assert pruning == POINTS * (192 + 4)
    planned = plan_bytes(plan) - pruning
    assert 0.97 * peak < planned < 1.03 * peak
    held = sum(
        a.nbytes for a in (trainer.model.cloud.arrays(dev) | trainer.state.arrays()).values()
    )
    tables = [
        PointCloud.table(POINTS, blocks),
        PointState.table(POINTS, blocks, trainer.config),
        PointState.ema_table(POINTS, blocks) if trainer.config.ema else {},
    ]
    assert held == sum(map(table_bytes, tables))


def test_pruning_stays_within_the_plan(dev, tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.device.compact.SCRATCH_BYTES", 10**6)
    others = dev.bytes  # what fixtures of other tests hold
    trainer, plan, _ = trained(dev, tmp_path / "ball", {})
    before, dev.peak_bytes = dev.bytes, dev.bytes
    trainer.state.peak_weight.set(np.arange(POINTS, dtype=np.float32))
    trainer.state.look_count.set(np.full(POINTS, 100, np.float32))
    trainer.prune()
    assert trainer.model.cloud.count == POINTS - 1
    assert dev.peak_bytes <= before + 10**6 + 2 * 4 * POINTS  # the weights and the list of the kept
    assert dev.peak_bytes - others <= plan_bytes(plan)


@pytest.mark.parametrize("lazy", ["false", "true"])
def test_the_papers_scale_fits_nine_gibibytes(dev, tmp_path, lazy):
    """Of a training scaled down: its points and hits take their share of 9 GiB, and 16 bits save
    half of the moments of 9 x 16 coefficients.
    """
    peaks = []
    for half in ("false", "true"):
        changes = {"train.crop": 24, "train.lazy_adam": lazy, "train.moments_16bit": half}
        _, _, peak = trained(dev, tmp_path / half, changes, base="paper")
        peaks.append(peak)
    assert peaks[0] < 9 * 2**30 * POINTS / PAPER_POINTS
    assert peaks[0] - peaks[1] == POINTS * 2 * 2 * 9 * 16


def test_a_plan_over_the_memory_names_the_knobs(dev):
    fits = [("points", {"ids": ((dev.info["memory_bytes"],), np.uint8)})]
    assert "points" in plan_lines(fits, dev)[1] and "total" in plan_lines(fits, dev)[-1]
    assert spare_memory(fits, dev, 0) == 0
    with pytest.raises(UserError, match="lower --points, .* train.moments_16bit"):
        spare_memory([*fits, ("more", {"one": ((1,), np.uint8)})], dev, 0)


def test_what_a_plan_leaves(dev):
    plan = [("a", {"a": ((2**28,), np.float32)}), ("b", {"b": ((2**29,), np.uint8)})]
    assert spare_memory(plan, dev, 0) == 0 and spare_memory(plan, dev, 2) == 2**29
    with pytest.raises(UserError, match="--memory 1: .* 1.50 GiB"):
        spare_memory(plan, dev, 1)
