"""The memory plan against what a training really allocates."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from support.scenes import write_ball_scene

from pp_cl.config import assign, preset
from pp_cl.device.buffers import table_bytes
from pp_cl.device.rows import compact_table
from pp_cl.metrics.lpips import WIDTHS, vgg_layers
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.raster.point_cloud import PointCloud
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.scene.open import open_scene
from pp_cl.scene.photograph import Photograph
from pp_cl.train import Trainer
from pp_cl.training.memory import Moment, Plan, Sketch, memory_plan, plan_lines
from pp_cl.training.point_state import PointState

POINTS = 27_000
PAPER_POINTS = 4_040_533  # lego, supplemental Table 4
SMOOTHED = {"train.sh_smoothing_every": "4"}  # so that the last few of 30 steps smooth too
WAYS = [
    {},
    {"raster.early_stop": "0"},
    {"train.ema": "false", "train.sh_smoothing": "0"},
    {"points.sh_degree": "1"},
    # discs of 1.5 spacings
    {"raster.footprint": "disc", "raster.radius": "0.09"},
    {"train.perceptual_weight": "0.1"},
    # to points that are eight, then 64 times as many, which are smoothed
    {
        "train.refine_at": "0.4,0.7",
        **SMOOTHED,
        "train.prune_weight": "0",
        "train.prune_opacity": "0",
    },
    {"train.refine_at": "1.0,0.9", **SMOOTHED},  # with the averages
]


@pytest.fixture(autouse=True)
def nothing_left_over():
    """What earlier tests left in reference cycles is released before memory is counted."""
    gc.collect()


def trained(dev, folder, changes, base="tiny"):
    """(Trainer, its plan, peak bytes) after some steps on a ball scene with a grid that has POINTS
    points in the end, and a preview.
    """
    side = round(POINTS ** (1 / 3)) >> sum(
        share < 1 for share in map(float, changes.get("train.refine_at", "1").split(","))
    )
    config = preset(base)
    settings = {
        "scene.path": write_ball_scene(folder, size=128),
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
    grid = Grid((-0.87, -0.87, -0.87), 1.74 / (side - 1), (side, side, side))
    net = UNet(dev, widths=config.network.widths)
    degree = config.points.sh_degree
    model = Model.create(dev, grid, np.arange(side**3), (2.0, 6.0), net=net, degree=degree)
    views = open_scene(dev, config, ("train",)).splits["train"]
    trainer = Trainer(dev, config, model, views)
    sketch = Sketch.unseen(config, net, [Photograph(v.name, v.file_camera) for v in views])
    plan = memory_plan(sketch.on_grid(grid, side**3, (2.0, 6.0)))
    for _ in range(30):
        trainer.train_step()
    trainer.render(views[0])
    return trainer, plan, dev.peak_bytes - before


def zero_weights():
    """Of LPIPS, in their shapes."""
    layers = vgg_layers()
    weights = {f"kernel{i}": np.zeros((x.co, x.ci, 3, 3)) for i, x in enumerate(layers)}
    weights |= {f"bias{i}": np.zeros(x.co, np.float32) for i, x in enumerate(layers)}
    return weights | {f"head{i}": np.zeros(width, np.float32) for i, width in enumerate(WIDTHS)}


@pytest.mark.parametrize(
    "changes", [*WAYS[:5], *(pytest.param(way, marks=pytest.mark.slow) for way in WAYS[5:])]
)
def test_the_plan_is_what_a_training_takes(dev, tmp_path, monkeypatch, changes):
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", zero_weights)
    trainer, plan, peak = trained(dev, tmp_path / "ball", changes)
    points = trainer.model.cloud.count
    blocks = trainer.model.cloud.blocks
    assert plan.peak.points == points and 0.8 * POINTS < points <= POINTS
    assert 0.96 * peak < plan.peak.device < 1.04 * peak
    held = sum(
        a.nbytes for a in (trainer.model.cloud.arrays(dev) | trainer.state.arrays()).values()
    )
    tables = [
        PointCloud.table(points, blocks),
        PointState.table(points),
        PointState.ema_table(points, blocks) if trainer.config.ema else {},
    ]
    assert held == sum(map(table_bytes, tables))


def test_pruning_stays_within_the_plan(dev, tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.device.rows.SCRATCH_BYTES", 10**6)
    others = dev.bytes  # what fixtures of other tests hold
    trainer, plan, _ = trained(dev, tmp_path / "ball", {"raster.radius": "0.75"})
    pruning = table_bytes(compact_table(POINTS, 192))
    assert pruning == POINTS * 4 + 10**6
    before, dev.peak_bytes = dev.bytes, dev.bytes
    trainer.state.peak_weight.set(np.arange(POINTS, dtype=np.float32))
    trainer.state.look_count.set(np.full(POINTS, 100, np.float32))
    trainer.prune()
    assert trainer.model.cloud.count == POINTS - 1
    assert dev.peak_bytes <= before + 10**6 + 2 * 4 * POINTS  # the weights and the list of the kept
    assert dev.peak_bytes - others <= plan.peak.device + pruning


def test_the_papers_scale_fits_six_gibibytes(dev, tmp_path):
    """Of a training scaled down: its points and hits take their share."""
    _, _, peak = trained(dev, tmp_path, {"train.crop": 24}, base="paper")
    assert peak < 6 * 2**30 * POINTS / PAPER_POINTS


def sketch(dev, base="tiny", points=171_262, step=0, **changes):
    """Of a preset with a small network and one photograph; `points` on the initial grid."""
    config = preset(base)
    for key, value in {"network.widths": "4,4,4", **changes}.items():
        assign(config, key.replace("__", "."), value, "test")
    camera = Camera(np.eye(3, 4), 900, 900, 400, 300, 800, 600)
    net = UNet(dev, widths=config.network.widths)
    found = Sketch.unseen(config, net, [Photograph("a.png", camera)] * 3)
    return found.on_grid(Grid((0, 0, 0), 0.02, (64, 64, 64)), points, (2, 6), step)


# points that trainings on lego had: preset, points at first, [(step, points)]
LEGO = [
    ("tiny", 252_312, [(6800, 112_900)]),
    ("small", 171_262, [(2100, 94_523 * 8), (5100, 555_797)]),
    ("full", 171_262, [(3630, 83_478 * 8), (7370, 455_094 * 8)]),
]


@pytest.mark.parametrize("name, first, later", LEGO)
def test_the_points_of_a_plan_are_near_those_of_lego(dev, name, first, later):
    plan = memory_plan(sketch(dev, name, first))
    starts = {m.name.split()[-2]: m.points for m in plan.moments if "refining" not in m.name}
    assert plan.moments[0].points == first
    for step, points in later:
        assert starts[str(step)] == pytest.approx(points, rel=0.06)


def test_a_plan_that_goes_on_counts_no_pruning_twice(dev):
    whole = memory_plan(sketch(dev, "small"))
    halfway = sketch(dev, "small", points=118_025, step=600)
    assert memory_plan(halfway).moments[-1].points == pytest.approx(
        whole.moments[-1].points, rel=0.05
    )
    last = memory_plan(sketch(dev, "small", points=600_000, step=4000))
    assert [m.name for m in last.moments] == ["from step 4000 on", "averages, from step 5100 on"]


def test_without_prunings_every_point_becomes_eight(dev):
    changes = {"train__refine_at": "0.1,0.2", "train__iterations": "100"}
    changes |= {"train__prune_weight": "0", "train__prune_opacity": "0"}
    plan = memory_plan(sketch(dev, "full", points=1000, **changes))
    assert [(m.name, m.points) for m in plan.moments] == [
        ("from step 0 on", 1000),
        ("refining after step 10", 8000),
        ("from step 10 on", 8000),
        ("refining after step 20", 64000),
        ("from step 20 on", 64000),
        ("averages, from step 85 on", 64000),
    ]
    tables = [dict(m.tables) for m in plan.moments]
    # crops of a quarter, of half and of the whole size; photographs as they are stored
    sides = [128, 128, 192, 192, 256, 256]
    assert all(f"network at {x}x{x}" in t for x, t in zip(sides, tables, strict=True))
    assert [bool(t["averages of the points"]) for t in tables] == 5 * [False] + [True]
    refining = tables[3]["refining"]
    assert table_bytes(refining) == 4 * 64_000 + 192 * 8000
    assert plan.moments[3].host == 320 * 8000
    assert plan.peak is plan.moments[-1]


@pytest.mark.parametrize(
    "changes, prunes",
    [
        ({}, True),
        ({"train__prune_every": "9000"}, False),
        ({"train__prune_looks": "7999"}, False),
        ({"train__prune_weight": "0"}, True),
        ({"train__prune_weight": "0", "train__prune_opacity": "0"}, False),
    ],
)
def test_pruning_is_planned_where_it_can_happen(dev, changes, prunes):
    first = memory_plan(sketch(dev, **changes)).moments[0]
    assert ("pruning (at most)" in dict(first.tables)) == prunes
    # a checkpoint every 1000 steps passes through the host in pieces of 64 MiB
    assert first.host == prunes * 24 * 171_262 + 2 * 2**26


def test_the_host_holds_photographs_and_the_buffers_of_a_cpu():
    buffers = [("a", {"x": ((100,), np.float32), "y": ((3,), np.uint8)})]
    moments = [Moment("now", 1, buffers, 1000), Moment("then", 2, buffers * 2, 7)]
    plan = Plan(moments, photographs=5000, reading=900)
    assert plan.peak.name == "then" and plan.peak.device == 806
    assert plan.largest == ("a: x", 400)
    assert plan.host(is_cpu=False) == 6000 and plan.host(is_cpu=True) == 5000 + 1403
    assert plan._replace(reading=2000).host(is_cpu=True) == 7000


def test_large_photographs_are_planned_as_they_are_kept(dev):
    few = sketch(dev, scene__downscale="8")
    phone = Camera(np.eye(3, 4), 4000, 4000, 2000, 1500, 4000, 3000)
    many = replace(few, photographs=[Photograph("a.png", phone)] * 300)
    assert many.shrunk == 8 and few.shrunk == 1
    plan = memory_plan(many)
    assert plan.photographs == 300 * 500 * 375 * 4
    assert dict(plan.peak.tables)["photograph and target"]["image"][0] == (375, 500, 4)
    assert memory_plan(few).photographs == 3 * 800 * 600 * 4


def test_the_plan_in_words(dev):
    plan = memory_plan(sketch(dev))
    lines = plan_lines(plan, dev)
    assert f"memory: {plan.peak.device / 2**20:.0f} of " in lines[0]
    assert "averages, from step 6800 on" in lines[0] or "from step 0 on" in lines[0]
    sizes = [float(line.split()[-2]) for line in lines[1:-2]]
    assert sum(sizes[:-1]) == pytest.approx(sizes[-1], abs=2)
    assert "largest buffer" in lines[-2] and "photographs" in lines[-1]
