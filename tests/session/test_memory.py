import gc
import math
import re

import numpy as np
import pyopencl as cl
import pytest
from support.refused import failure
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.config import assign, load_config, preset, run_config
from pp_cl.engine.camera import Camera
from pp_cl.engine.device.buffers import table_bytes
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.host import resident_bytes
from pp_cl.engine.grid import Grid
from pp_cl.engine.network.unet import UNet
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import load
from pp_cl.scene.image_file import ImageFile
from pp_cl.session.memory import FILLED, GIB, MIB, MemoryPlan
from pp_cl.session.training import open_training

GRID = Grid((0, 0, 0), 0.02, (64, 64, 64))


@pytest.fixture
def plain(dev, monkeypatch):
    """A new device without guards, in a machine with memory to spare."""
    gc.collect()  # earlier tests may have left buffers in reference cycles, which would be counted
    monkeypatch.setattr("pp_cl.session.memory.available_bytes", lambda: 2**45)
    made = Device(dev.device)
    made.info |= {"memory_bytes": 2**45, "max_allocation_bytes": 2**45}
    return made


BALL = {"points.count": 4000, "scene.downscale": 1, "network.blocks": "double"}


@pytest.mark.parametrize(
    "size, settings",
    [
        (400, {}),
        (128, BALL | {"train.refine_at": "0.4,1"}),  # the refinement makes eight times the points
        (128, BALL | {"raster.footprint": "disc", "raster.radius": 0.1}),
    ],
)
def test_it_is_within_15_percent_of_what_a_training_takes(
    plain, tmp_path, monkeypatch, size, settings
):
    monkeypatch.setattr("pp_cl.engine.training.between.SMOOTHING_EVERY", 8)
    scene = write_ball_scene(tmp_path / "ball", size=size)
    settings |= {"train.iterations": 24, "train.prune_weight": 0}
    folder = RunFolder(tmp_path / "run")
    config = run_config(folder, scene, "tiny", [(*setting, "test") for setting in settings.items()])
    training = open_training(plain, folder, config, None)
    training.run()
    need = training.memory_plan.need
    assert need.points == training.trainer.model.cloud.count
    assert 0.85 < need.device / plain.peak_bytes < 1.15


class Card(Device):
    """A device that records which kernels are launched in which groups."""

    def __init__(self, device):
        super().__init__(device)
        self.launched = set()

    def enqueue(self, launch):
        self.launched.add((launch.kernel, launch.local))
        super().enqueue(launch)


def test_a_small_card_gets_the_points_that_fit(dev, tmp_path, monkeypatch, capsys):
    """The GPU form runs within limits that every GPU offers: --memory 0.1, allocations of 28 MiB,
    groups of 256, local memory of 32 KiB. Points are refined as with more memory.
    """
    monkeypatch.setenv("PP_FORM", "gpu")
    monkeypatch.setenv("PP_MAX_ALLOCATION", "28")
    card, folder = Card(dev.device), RunFolder(tmp_path / "run")
    monkeypatch.setattr("pp_cl.drivers.open_device", lambda choice: card)
    scene = write_ball_scene(tmp_path / "ball", size=128)
    words = ["train", scene, "--out", str(folder), "--downscale", "1", "--points", "4000"]
    words += ["--memory", "0.1", "--iterations", "24", "--set", "train.prune_weight=0"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert re.search("points: as close as memory allows; .*--memory 0.1: the training needs", text)
    assert "features: of one sample a pixel in the end (--memory 0.1" in text
    train = load_config(folder.config).train
    assert train.refine_at == (0.35, 1) and train.supersampled == 0
    plan = float(re.search(r"memory: up to (\S+) MiB of --memory 0.1", text)[1]) * MIB
    assert FILLED - 0.05 < plan / (0.1 * GIB) < FILLED + 0.001
    assert 0.85 < plan / card.peak_bytes < 1.15
    assert max(math.prod(group) for _, group in card.launched) == 256
    limit = cl.kernel_work_group_info.LOCAL_MEM_SIZE
    local = [kernel._kernel.get_work_group_info(limit, card.device) for kernel, _ in card.launched]
    assert 0 < max(local) <= 32 * 1024


@pytest.mark.parametrize("steps, at", [((60,), 45), ((6, 60), 45)], ids=["new", "extended"])
def test_what_was_to_be_supersampled_is_given_up_before_points(
    tmp_path, monkeypatch, capsys, steps, at
):
    def fault_of(self, grid, points, depth_range, progress=0.0, share=1.0):
        train = self._config.train
        return ("little", "") if train.supersampled and train.iterations * progress > 10 else None

    monkeypatch.setattr(MemoryPlan, "fault_of", fault_of)
    folder, scene = RunFolder(tmp_path / "run"), write_ball_scene(tmp_path / "ball")
    for count in steps:
        words = arguments(scene, folder.path, train__iterations=count)
        assert main(words) == 0
    assert f"step {at}: for lack of memory, features are of one sample" in capsys.readouterr().err
    assert load_config(folder.config).train.supersampled == 0
    assert load(folder.path).renderer.supersampling == 1


def test_only_flat_discs_by_alpha_are_planned_with_samples(tmp_path):
    """A softmax has one sample a pixel anyhow, so nothing is counted for four or given up."""
    folder, scene = RunFolder(tmp_path / "run"), write_ball_scene(tmp_path / "ball")
    asked = {"raster__blend": "softmax", "train__supersampled": 0.25}
    for steps in (2, 3):  # asked for again, it is not refused
        assert main(arguments(scene, folder.path, train__iterations=steps, **asked)) == 0
        assert load_config(folder.config).train.supersampled == 0


def memory_plan(dev, base="tiny", images=3, size=(800, 600), **changes):
    config = preset(base)
    settings = {"network.widths": "16,16,16", "raster.radius": "0.85"} | changes
    for key, value in settings.items():
        assign(config, key.replace("__", "."), value, "test")
    width, height = size
    camera = Camera(np.eye(3, 4), width, width, width / 2, height / 2, width, height)
    net = UNet(dev, widths=config.network.widths)
    return MemoryPlan(config, net, [ImageFile(f"{i}.png", camera) for i in range(images)])


def test_each_compute_unit_has_memory_of_its_own(dev, cpu_form, plain, monkeypatch):
    """Convolutions transform tiles in a buffer per compute unit, which adds up on 128 cores."""
    planned, shared, taken = [], [], []
    for units in (2, 256):
        made = Device(dev.device)
        for device in (made, plain):
            monkeypatch.setitem(device.info, "compute_units", units)
        net = UNet(made, widths=(32, 64, 128))
        image = net.forward(made.zeros((128, 128, 16)))
        net.backward(made.zeros(image.shape))
        taken.append(made.peak_bytes)
        shared.append(table_bytes(net.table((128, 128), (128, 128))))
        planned.append(needed(plain, size=(128, 128), network__widths="32,64,128").device)
    assert np.ptp(taken) > 2**28
    assert np.ptp(shared) == pytest.approx(np.ptp(taken), rel=0.01)
    assert np.ptp(planned) == pytest.approx(np.ptp(taken), rel=0.01)


def needed(dev, base="tiny", points=171_262, progress=0.0, **changes):
    return memory_plan(dev, base, **changes).need_of(GRID, points, (2, 6), progress)


def test_a_training_that_goes_on_counts_no_pruning_twice(dev):
    once = {"train__refine_at": "0.35,1", "train__supersampled": "0"}
    halfway = needed(dev, "small", points=118_025, progress=0.1, **once)
    assert halfway.points < needed(dev, "small", **once).points  # it still fits
    last = needed(dev, "small", points=600_000, progress=0.67, **once)
    assert last.points == 600_000


def test_a_refined_grid_is_expected_to_take_what_was_planned_before(dev):
    made = memory_plan(dev, train__refine_at="0.4,1", train__prune_weight="0", size=(400, 300))
    finer = Grid(GRID.origin, GRID.voxel_size / 2, tuple(2 * n for n in GRID.dims))
    planned, later = made.need_of(GRID, 20_000, (2, 6)), made.need_of(finer, 160_000, (2, 6), 0.875)
    assert planned.points == later.points == 160_000
    assert later.device == pytest.approx(planned.device, rel=0.01)


def test_a_grid_is_not_refined_beyond_what_ids_can_number(dev):
    """A thin object has few points even in the largest grid."""
    made = memory_plan(dev, "full", train__refine_at="0.3,0.6")
    largest, larger = (Grid((0, 0, 0), 1e-3, (n, 512, 512)) for n in (256, 257))
    made.check_points(largest, 1000, (2, 6))
    with pytest.raises(UserError, match="train.refine_at"):
        made.check_points(larger, 1000, (2, 6))


def test_images_are_counted_as_they_are_kept(dev):
    sizes = {"size": (4000, 3000), "scene__downscale": "8"}
    fewer, more = (needed(dev, images=count, **sizes).host for count in (300, 400))
    assert more - fewer == 100 * 500 * 375 * 4


def check(made, points=20_000):
    made.check_points(GRID, points, (2, 6))


def refusal(made, points=20_000):
    with pytest.raises(UserError) as caught:
        check(made, points)
    text = str(caught.value)
    assert all(word in text for word in ("--points", "--downscale", "train.crop"))
    return text


@pytest.mark.parametrize(
    "what, limit, told",
    [("device", "memory_bytes", "needs"), ("largest", "max_allocation_bytes", "at once")],
)
def test_what_fits_is_accepted_and_a_byte_less_is_not(plain, what, limit, told):
    plain.info[limit] = getattr(needed(plain, points=20_000), what)
    check(memory_plan(plain))
    plain.info[limit] -= 1
    assert told in refusal(memory_plan(plain)) and plain.name in refusal(memory_plan(plain))


def test_the_memory_asked_for(plain):
    least = needed(plain, points=20_000).device / GIB
    check(memory_plan(plain, train__memory_gib=f"{1.01 * least:.4f}"))
    text = refusal(memory_plan(plain, train__memory_gib=f"{0.8 * least:.3f}"))
    assert text.startswith(f"--memory {round(0.8 * least, 3)}")
    assert f"give --memory {np.ceil(100 * least) / 100:g}" in text


def test_the_hosts_memory(plain, monkeypatch):
    """The host must hold the images, and on a CPU the buffers, too."""
    image_files = {"images": 300, "size": (4000, 3000), "scene__downscale": "1"}
    available = "pp_cl.session.memory.available_bytes"
    monkeypatch.setattr(available, lambda: resident_bytes() + 2 * GIB)
    assert "of the host's memory" in refusal(memory_plan(plain, **image_files))
    check(memory_plan(plain))


def test_before_the_hull_is_known_no_more_is_refused_than_must_be(plain):
    made = memory_plan(plain)
    plain.info["memory_bytes"] = needed(plain, points=preset("tiny").points.count).device
    made.check_unseen()
    plain.info["memory_bytes"] = MIB
    with pytest.raises(UserError):
        made.check_unseen()


def test_what_does_not_fit_any_more_is_dropped_but_for_half(plain):
    made, (points, done) = memory_plan(plain, train__refine_at="0.4,1"), (20_000, 0.375)
    plain.info["memory_bytes"] = made.need_of(GRID, points, (2, 6), done).device
    assert made.points_that_fit(GRID, points, (2, 6), done) == points
    assert made.points_that_fit(GRID, 3 * points // 2, (2, 6), done) > 3 * points // 4
    assert made.need.device == pytest.approx(FILLED * plain.info["memory_bytes"], rel=1e-3)
    with pytest.raises(UserError, match="needs"):
        made.points_that_fit(GRID, 3 * points, (2, 6), done)


def test_what_the_next_steps_take_is_not_dropped(plain):
    made = memory_plan(plain, train__refine_at="0.4,1")
    plain.info["memory_bytes"] = made.need_of(GRID, 100_000, (2, 6), 0.99).device
    assert made.points_that_fit(GRID, 100_000, (2, 6), 0.99) == 100_000
    with pytest.raises(UserError, match="needs"):
        made.points_that_fit(GRID, 101_000, (2, 6), 0.99)


@pytest.mark.slow
def test_a_refinement_that_does_not_fit_has_less_to_refine_or_keeps_what_is_learned(
    plain, tmp_path, monkeypatch, capsys
):
    scene = write_ball_scene(tmp_path / "ball", size=64)
    settings = {"train__refine_at": "0.5,1", "train__iterations": 40, "train__ema": "false"}
    settings |= {"train__prune_every": 1000, "train__checkpoint_every": 1000}
    settings |= {"train__supersampled": 0}  # otherwise supersampling would be given up first
    settings |= {"train__specular": "off"}  # otherwise its fit would need too much memory
    schedule = "pp_cl.engine.training.schedule"
    monkeypatch.setattr(f"{schedule}.LEFT_BY_PRUNING", 0.05)
    monkeypatch.setattr(f"{schedule}.prunings", lambda train, start, end: int(end > start + 1))
    monkeypatch.setattr("pp_cl.drivers.open_device", lambda choice: plain)
    settings |= {"downscale": 1, "points__count": 5000}
    plain.info["memory_bytes"] = 30 * MIB
    assert main(arguments(scene, tmp_path / "fewer", **settings)) == 0
    dropped, count = map(int, re.search(r"20: .* (\d+) of (\d+)", capsys.readouterr().err).groups())
    assert 0.1 < dropped / count < 0.5 and plain.peak_bytes > (FILLED - 0.15) * 30 * MIB

    plain.info["memory_bytes"] = 20 * MIB
    words = arguments(scene, tmp_path / "run", **settings)
    error = failure(*words)
    assert "step 20: to go on with " in error and error.endswith("in another --out")
    plain.info["memory_bytes"] = GIB
    assert main(words) == 0
    assert "resuming at step 20 " in capsys.readouterr().out
    points = {row["step"]: row["points"] for row in RunFolder(tmp_path / "run").rows()}
    assert points[25] == 8 * points[15]  # it is refined after the step that it resumes with
