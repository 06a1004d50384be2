"""The memory plan against what a training really allocates, and what is refused by it."""

import gc

import numpy as np
import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.config import assign, preset
from pp_cl.device.buffers import compact_table, table_bytes
from pp_cl.device.device import Device
from pp_cl.device.host import resident_bytes
from pp_cl.errors import UserError
from pp_cl.files.checkpoint import load_checkpoint
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.scene.load import open_scene
from pp_cl.scene.views import Photograph
from pp_cl.train import Trainer
from pp_cl.training.memory import GIB, MIB, MemoryPhase, Plan, Room, plan_lines

POINTS = 27_000
PAPER_POINTS = 4_040_533  # lego, supplemental Table 4
WAYS = [
    {},
    {"raster.early_stop": "0"},
    {"train.ema": "false", "train.sh_smoothing": "0", "train.exposure": "off"},
    {"points.sh_degree": "1"},
    # discs of 1.5 spacings
    {"raster.footprint": "disc", "raster.radius": "0.09"},
    # to points that are eight, then 64 times as many, which are smoothed
    {
        "train.refine_at": "0.4,0.7",
        "train.prune_weight": "0",
        "train.prune_opacity": "0",
    },
    {"train.refine_at": "1.0,0.9"},  # with the averages
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
        "train.sh_smoothing_every": 4,  # so that the last few of 30 steps smooth too
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
    room = Room(config, net, [Photograph(v.name, v.file_camera) for v in views])
    plan = room.plan_points(grid, side**3, (2.0, 6.0))
    for _ in range(30):
        trainer.train_step()
    trainer.render(views[0])
    return trainer, plan, dev.peak_bytes - before


@pytest.mark.parametrize(
    "changes", [*WAYS[:5], *(pytest.param(way, marks=pytest.mark.slow) for way in WAYS[5:])]
)
def test_the_plan_is_what_a_training_takes(plain, tmp_path, changes):
    trainer, plan, peak = trained(plain, tmp_path / "ball", changes)
    points = trainer.model.cloud.count
    assert plan.peak.points == points and 0.8 * POINTS < points <= POINTS
    assert 0.96 * peak < plan.peak.device < 1.04 * peak
    held = trainer.model.cloud.arrays(plain) | trainer.optimiser.arrays()
    kept = ("points", "training state of the points", "averages of the points", "optimiser")
    planned = sum(table_bytes(plan.phases[-1].tables[name]) for name in kept)
    # the network's parameters lie apart, as devices align them
    assert 0.999 * planned < sum(array.nbytes for array in held.values()) <= planned


def test_pruning_stays_within_the_plan(plain, tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.device.buffers.SCRATCH_BYTES", 10**6)
    others = plain.bytes  # what fixtures of other tests hold
    trainer, plan, _ = trained(plain, tmp_path / "ball", {"raster.radius": "0.75"})
    pruning = table_bytes(compact_table(POINTS, 192))
    assert pruning == POINTS * 4 + 10**6
    before, plain.peak_bytes = plain.bytes, plain.bytes
    trainer.state.max_weight.set(np.arange(POINTS, dtype=np.float32))
    trainer.state.times_seen.set(np.full(POINTS, 100, np.float32))
    trainer.prune()
    assert trainer.model.cloud.count == POINTS - 1
    assert (
        plain.peak_bytes <= before + 10**6 + 2 * 4 * POINTS
    )  # the weights and the list of the kept
    assert plain.peak_bytes - others <= plan.peak.device + pruning


def test_the_papers_scale_fits_six_gibibytes(plain, tmp_path):
    """Of a training scaled down: its points and hits take their share."""
    _, _, peak = trained(plain, tmp_path, {"train.crop": 24}, base="paper")
    assert peak < 6 * 2**30 * POINTS / PAPER_POINTS


GRID = Grid((0, 0, 0), 0.02, (64, 64, 64))


def room(dev, base="tiny", images=3, size=(800, 600), **changes):
    """Of a training with a small network."""
    config = preset(base)
    settings = {"network.widths": "16,16,16"} | changes
    for key, value in settings.items():
        assign(config, key.replace("__", "."), value, "test")
    width, height = size
    camera = Camera(np.eye(3, 4), width, width, width / 2, height / 2, width, height)
    net = UNet(dev, widths=config.network.widths)
    return Room(config, net, [Photograph(f"{i}.png", camera) for i in range(images)])


ONCE = {"train__refine_at": "0.35,1"}


def planned(dev, base="tiny", points=171_262, step=0, **changes):
    return room(dev, base, **changes).plan_points(GRID, points, (2, 6), step)


@pytest.mark.parametrize(
    "name, shares, first, most",
    [
        ("tiny", "1,1", 252_312, 252_312),
        ("small", "0.35,1", 171_262, 94_523 * 8),
        ("full", "0.33,0.67", 171_262, 455_094 * 8),
    ],
)
def test_the_most_points_of_a_plan_are_near_those_of_lego(dev, name, shares, first, most):
    plan = planned(dev, name, first, train__refine_at=shares)
    assert max(phase.points for phase in plan.phases) == pytest.approx(most, rel=0.1)


def test_a_grid_is_not_refined_beyond_what_ids_can_number(dev):
    """Of a thin object, whose few points lie in the largest grid."""
    made = room(dev, "full", train__refine_at="0.3,0.6")
    largest, larger = (Grid((0, 0, 0), 1e-3, (n, 512, 512)) for n in (256, 257))
    made.check_points(largest, 1000, (2, 6))
    with pytest.raises(UserError, match="train.refine_at"):
        made.check_points(larger, 1000, (2, 6))


def test_a_plan_that_goes_on_counts_no_pruning_twice(dev):
    halfway = planned(dev, "small", points=118_025, step=600, **ONCE)
    assert (
        halfway.peak.points < planned(dev, "small", **ONCE).peak.points
    )  # so it goes on where it began
    last = planned(dev, "small", points=600_000, step=4000, **ONCE)
    assert [p.name for p in last.phases] == ["from step 4000 on", "averages, from step 5100 on"]
    assert last.phases[0].points == 600_000


def test_without_prunings_every_point_becomes_eight(dev):
    changes = {"train__refine_at": "0.1,0.2", "train__iterations": "100"}
    changes |= {"train__prune_weight": "0", "train__prune_opacity": "0"}
    plan = planned(dev, "full", points=1000, scene__downscale="1", **changes)
    assert [(p.name, p.points) for p in plan.phases] == [
        ("from step 0 on", 1000),
        ("refining after step 10", 8000),
        ("from step 10 on", 8000),
        ("refining after step 20", 64000),
        ("from step 20 on", 64000),
        ("averages, from step 85 on", 64000),
    ]
    # crops of a quarter, of half and of the whole size
    sides = [128, 128, 192, 192, 256, 256]
    tables = [phase.tables for phase in plan.phases]
    assert all(f"network at {x}x{x}" in t for x, t in zip(sides, tables, strict=True))
    assert [bool(t["averages of the points"]) for t in tables] == 5 * [False] + [True]
    assert table_bytes(tables[3]["refining"]) == 4 * 64_000 + 192 * 8000
    assert plan.phases[3].host == 320 * 8000
    assert plan.peak is plan.phases[-1]


@pytest.mark.parametrize(
    "changes, prunes",
    [
        ({}, True),
        ({"train__prune_every": "9000"}, False),
        ({"train__prune_weight": "0", "train__prune_opacity": "0"}, False),
    ],
)
def test_pruning_is_planned_where_it_can_happen(dev, changes, prunes):
    plan = planned(dev, **changes)
    assert plan.phases[1].points == (round(0.6 * 171_262) if prunes else 171_262)
    # a checkpoint passes through the host in pieces of 64 MiB
    assert plan.phases[0].host == prunes * 24 * 171_262 + 2 * 2**26


def test_the_host_holds_photographs_and_the_buffers_of_a_cpu():
    buffers = {"a": {"x": ((100,), np.float32), "y": ((3,), np.uint8)}}
    phases = [
        MemoryPhase("now", 1, buffers, 1000),
        MemoryPhase("then", 2, buffers | {"b": buffers["a"]}, 7),
    ]
    plan = Plan(phases, photographs=5000, reading=900)
    assert plan.peak.name == "then" and plan.peak.device == 806
    assert plan.largest == ("a: x", 400)
    assert plan.host(is_cpu=False) == 6000 and plan.host(is_cpu=True) == 5000 + 1403
    assert plan._replace(reading=2000).host(is_cpu=True) == 7000


def test_large_photographs_are_planned_as_they_are_kept(dev):
    plan = planned(dev, images=300, size=(4000, 3000), scene__downscale="8")
    assert plan.photographs == 300 * 500 * 375 * 4
    assert plan.peak.tables["photograph and target"]["image"][0] == (375, 500, 4)
    assert planned(dev, scene__downscale="8").photographs == 3 * 800 * 600 * 4


def test_the_plan_in_words(dev):
    plan = planned(dev)
    lines = plan_lines(plan, dev)
    assert f"memory: {plan.peak.device / 2**20:.0f} of " in lines[0] and plan.peak.name in lines[0]
    sizes = [float(line.split()[-2]) for line in lines[1:-2]]
    assert sum(sizes[:-1]) == pytest.approx(sizes[-1], abs=2)
    assert "largest buffer" in lines[-2] and "photographs" in lines[-1]


# ---- what there is


@pytest.fixture
def plain(dev, monkeypatch):
    """A device of the test's own, in a machine with memory to spare."""
    monkeypatch.setattr("pp_cl.training.memory.available_bytes", lambda: 2**45)
    made = Device(dev.device)
    made.info |= {"memory_bytes": 2**45, "max_allocation_bytes": 2**45}
    return made


def check(made, points=20_000):
    made.check_points(GRID, points, (2, 6))


def refusal(made, points=20_000):
    """The one line by which a training is refused; it names what to lower."""
    with pytest.raises(UserError) as caught:
        check(made, points)
    text = str(caught.value)
    assert "\n" not in text
    assert all(word in text for word in ("--points", "--downscale", "train.crop"))
    return text


def test_what_fits_is_accepted_and_a_byte_less_is_not(plain):
    device = planned(plain, points=20_000).peak.device
    plain.info["memory_bytes"] = device
    made = room(plain)
    check(made)
    assert made.plan.peak.device == device
    plain.info["memory_bytes"] = device - 1
    assert plain.name in refusal(room(plain))


def test_a_buffer_over_the_largest_allocation(plain):
    _, largest = planned(plain, points=20_000).largest
    plain.info["max_allocation_bytes"] = largest
    check(room(plain))
    plain.info["max_allocation_bytes"] = largest - 1
    assert "allocates at once" in refusal(room(plain))


def test_the_memory_asked_for(plain):
    needed = planned(plain, points=20_000).peak.device / GIB
    check(room(plain, train__memory_gib=f"{1.01 * needed:.4f}"))
    text = refusal(room(plain, train__memory_gib=f"{0.8 * needed:.3f}"))
    assert text.startswith(f"--memory {round(0.8 * needed, 3)}")
    assert f"give --memory {np.ceil(100 * needed) / 100:g}" in text


def test_the_hosts_memory(plain, monkeypatch):
    """Of photographs and of a CPU's buffers; a system that does not tell refuses nothing."""
    photographs = {"images": 300, "size": (4000, 3000), "scene__downscale": "1"}
    available = "pp_cl.training.memory.available_bytes"
    monkeypatch.setattr(available, lambda: resident_bytes() + GIB)
    assert "of the host's memory" in refusal(room(plain, **photographs))
    check(room(plain))
    monkeypatch.setattr(available, lambda: None)
    check(room(plain, **photographs))


@pytest.mark.parametrize("base", ["tiny", "small", "paper"])
def test_presets_on_a_device_of_four_gibibytes(plain, base):
    plain.info |= {"memory_bytes": 4 * GIB, "max_allocation_bytes": 2 * GIB}
    points = preset(base).points.count
    if base == "paper":
        refusal(room(plain, base, network__widths="128,256,512"), points)
    else:
        check(room(plain, base), points)


def test_before_the_hull_is_known_no_more_is_refused_than_must_be(plain):
    made = room(plain)
    plain.info["memory_bytes"] = planned(plain, points=preset("tiny").points.count).peak.device
    made.check_unseen()
    plain.info["memory_bytes"] = MIB
    with pytest.raises(UserError):
        made.check_unseen()


def run(dev, monkeypatch, *words):
    """Status of a command on a device."""
    monkeypatch.setattr("pp_cl.device.discover.open_device", lambda choice: dev)
    return main(list(words))


@pytest.mark.slow
def test_a_refinement_that_does_not_fit_keeps_what_is_learned(plain, tmp_path, monkeypatch, capsys):
    """More points are left than the plan took them to be."""
    scene = write_ball_scene(tmp_path / "ball", size=64)
    settings = {"train__refine_at": "0.5,1", "train__iterations": 40, "train__ema": "false"}
    settings |= {"train__prune_every": 1000, "train__checkpoint_every": 1000}
    monkeypatch.setattr("pp_cl.training.memory.KEPT_BY_PRUNING", 0.05)
    monkeypatch.setattr(
        "pp_cl.training.memory.prunings", lambda train, start, end: int(end > start + 1)
    )
    plain.info["memory_bytes"] = 25 * MIB

    def train(name, points):
        words = arguments(scene, tmp_path / name, downscale=1, points__count=points, **settings)
        return run(plain, monkeypatch, *words)

    assert train("run", 5000) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert "step 19: to go on with " in told and told.endswith("in another --out")
    assert load_checkpoint(tmp_path / "run/checkpoint.npz")[0]["step"] == 19
    plain.info["memory_bytes"] = GIB
    assert train("run", 5000) == 0
