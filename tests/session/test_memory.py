import gc
import math
import re

import numpy as np
import pyopencl as cl
import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.config import assign, load_config, preset, run_config
from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.host import resident_bytes
from pp_cl.engine.grid import Grid
from pp_cl.engine.network.unet import UNet
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import load
from pp_cl.scene.image_file import ImageFile
from pp_cl.session.decide import least
from pp_cl.session.memory import CAREFUL, FILLED, GIB, MIB, Memory, Place
from pp_cl.session.training import open_training

GRID = Grid((0, 0, 0), 0.02, (64, 64, 64))
PLACE = Place(GRID, 20_000, (2, 6))


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
def test_a_training_takes_no_more_and_at_least_four_fifths_of_it(
    plain, tmp_path, monkeypatch, size, settings
):
    monkeypatch.setattr("pp_cl.engine.training.between.SMOOTHING_EVERY", 8)
    scene = write_ball_scene(tmp_path / "ball", size=size)
    settings |= {"train.iterations": 24, "train.prune_weight": 0}
    folder = RunFolder(tmp_path / "run")
    config = run_config(folder, scene, "tiny", [(*setting, "test") for setting in settings.items()])
    training = open_training(plain, folder, config, None)
    need = training.memory.need(training.config, training.place)
    training.run()
    assert need.points == training.trainer.model.cloud.count
    assert 1 <= need.device / plain.peak_bytes < 1.25


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
    assert re.search(
        "points: .* as close as memory allows; .*--memory 0.1: the training needs", text
    )
    assert "samples: one a pixel, for lack of memory (--memory 0.1" in text
    train = load_config(folder.config).train
    assert train.refine_at == (0.35, 1) and train.supersampled == 0
    plan = float(re.search(r"memory: up to (\S+) MiB of --memory 0.1", text)[1]) * MIB
    assert FILLED - 0.05 < plan / (0.1 * GIB) < FILLED + 0.001
    assert 1 <= plan / card.peak_bytes < 1.25
    assert max(math.prod(group) for _, group in card.launched) == 256
    limit = cl.kernel_work_group_info.LOCAL_MEM_SIZE
    local = [kernel._kernel.get_work_group_info(limit, card.device) for kernel, _ in card.launched]
    assert 0 < max(local) <= 32 * 1024


@pytest.mark.parametrize("steps, at", [((60,), 45), ((6, 60), 45)], ids=["new", "extended"])
def test_what_was_to_be_supersampled_is_given_up_before_points(
    tmp_path, monkeypatch, capsys, steps, at
):
    def fault(self, config, place=None, progress=0.0, share=1.0):
        train = config.train
        return ("little", "") if train.supersampled and train.iterations * progress > 10 else None

    monkeypatch.setattr(Memory, "fault", fault)
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


def memory_of(dev, base="tiny", images=3, size=(800, 600), **changes):
    """(settings, their Memory)."""
    config = preset(base)
    settings = {"network.widths": "16,16,16", "raster.radius": "0.85"} | changes
    for key, value in settings.items():
        assign(config, key.replace("__", "."), value, "test")
    width, height = size
    camera = Camera(np.eye(3, 4), width, width, width / 2, height / 2, width, height)
    net = UNet(dev, widths=config.network.widths)
    return config, Memory(config, net, [ImageFile(f"{i}.png", camera) for i in range(images)])


def needed(dev, place=PLACE, progress=0.0, **changes):
    config, memory = memory_of(dev, **changes)
    return memory.need(config, place, progress)


def test_each_compute_unit_has_memory_of_its_own(dev, cpu_form, plain, monkeypatch):
    """Convolutions transform tiles in a buffer per compute unit, which adds up on 128 cores."""
    planned, taken = [], []
    for units in (2, 256):
        made = Device(dev.device)
        for device in (made, plain):
            monkeypatch.setitem(device.info, "compute_units", units)
        net = UNet(made, widths=(32, 64, 128))
        image = net.forward(made.zeros((128, 128, 16)))
        net.backward(made.zeros(image.shape))
        taken.append(made.peak_bytes)
        planned.append(needed(plain, size=(128, 128), network__widths="32,64,128").device)
    assert np.ptp(taken) > 2**28
    assert np.ptp(planned) == pytest.approx(CAREFUL * np.ptp(taken), rel=0.01)


def test_a_refined_grid_is_expected_to_take_what_was_bounded_before(dev):
    config, memory = memory_of(dev, train__refine_at="0.4,1", train__prune_weight="0")
    bounded, later = (memory.need(config, PLACE.refined(n), 0.4 * n) for n in (0, 1))
    assert bounded.points == later.points == 160_000 and later.device == bounded.device


def test_a_grid_is_not_refined_beyond_what_ids_can_number(dev):
    """A thin object has few points even in the largest grid."""
    config, memory = memory_of(dev, "full", train__refine_at="0.3,0.6")
    largest, larger = (Grid((0, 0, 0), 1e-3, (n, 512, 512)) for n in (256, 257))
    memory.check(config, Place(largest, 1000, (2, 6)))
    with pytest.raises(UserError, match=r"train\.refine_at"):
        memory.check(config, Place(larger, 1000, (2, 6)))


def test_images_are_counted_as_they_are_kept(dev):
    sizes = {"size": (4000, 3000), "scene__downscale": "8"}
    fewer, more = (needed(dev, images=count, **sizes).host for count in (300, 400))
    assert more - fewer == 100 * 500 * 375 * 4


def refusal(config, memory):
    with pytest.raises(UserError) as caught:
        memory.check(config, PLACE)
    text = str(caught.value)
    assert all(word in text for word in ("--points", "--downscale", "train.crop"))
    return text


@pytest.mark.parametrize(
    "what, limit, told",
    [("device", "memory_bytes", "needs"), ("largest", "max_allocation_bytes", "at once")],
)
def test_what_fits_is_accepted_and_a_byte_less_is_not(plain, what, limit, told):
    config, memory = memory_of(plain)
    plain.info[limit] = getattr(memory.need(config, PLACE), what)
    memory.check(config, PLACE)
    plain.info[limit] -= 1
    assert told in refusal(config, memory) and plain.name in refusal(config, memory)


def test_the_memory_asked_for(plain):
    needs = needed(plain).device / GIB
    config, memory = memory_of(plain, train__memory_gib=f"{1.01 * needs:.4f}")
    memory.check(config, PLACE)
    text = refusal(*memory_of(plain, train__memory_gib=f"{0.8 * needs:.3f}"))
    assert text.startswith(f"--memory {round(0.8 * needs, 3)}")
    assert f"give --memory {np.ceil(100 * needs) / 100:g}" in text


def test_the_hosts_memory(plain, monkeypatch):
    """The host must hold the images, and on a CPU the buffers, too."""
    available = "pp_cl.session.memory.available_bytes"
    monkeypatch.setattr(available, lambda: resident_bytes() + 2 * GIB)
    many = memory_of(plain, images=300, size=(4000, 3000), scene__downscale="1")
    assert "of the host's memory" in refusal(*many)
    config, memory = memory_of(plain)
    memory.check(config, PLACE)


def test_before_the_hull_is_known_no_more_is_refused_than_must_be(plain):
    config, memory = memory_of(plain)
    plain.info["memory_bytes"] = needed(plain, PLACE._replace(points=config.points.count)).device
    memory.check(least(config))
    plain.info["memory_bytes"] = MIB
    with pytest.raises(UserError):
        memory.check(least(config))


def test_points_are_as_many_as_fit(plain):
    config, memory = memory_of(plain, train__refine_at="0.4,1")
    plain.info["memory_bytes"] = memory.need(config, PLACE).device
    fitting = memory.most_points(config, PLACE)
    assert 0.5 * PLACE.points < fitting < PLACE.points
    need = memory.need(config, PLACE.spaced(fitting))
    assert need.device == pytest.approx(FILLED * plain.info["memory_bytes"], rel=1e-3)


@pytest.mark.parametrize(
    "key, told",
    [("refine_at", "points are not refined"), ("ema", "parameters are not averaged")],
)
def test_what_does_not_fit_later_is_given_up_and_the_training_ends(
    plain, tmp_path, monkeypatch, capsys, key, told
):
    """It is checked before more memory is taken, and tells what it does without."""
    scene, folder = write_ball_scene(tmp_path / "ball", size=64), RunFolder(tmp_path / "run")
    monkeypatch.setattr("pp_cl.drivers.open_device", lambda choice: plain)
    settings = {"train__refine_at": "0.5,1", "train__iterations": 40, "downscale": 1}
    settings |= {"train__prune_every": 1000, "train__supersampled": 0, "train__specular": "off"}
    bound = Memory.fault

    def fault(self, config, place=None, progress=0.0, share=1.0):
        grows = place and place.points > 5000 if key == "refine_at" else config.train.ema
        late = progress >= {"refine_at": 0.5, "ema": 0.8}[key]
        return ("little is left", "") if late and grows else bound(self, config, place)

    monkeypatch.setattr(Memory, "fault", fault)
    assert main(arguments(scene, folder.path, points__count=1000, **settings)) == 0
    assert f"for lack of memory, {told}" in capsys.readouterr().err
    config = load_config(folder.config)
    assert config.train.ema == (key != "ema")
    assert "little is left" in config.decisions[f"train.{key}"]
    assert load(folder.path).progress == 1
