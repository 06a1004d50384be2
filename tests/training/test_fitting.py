"""What does not fit is refused in one line, and its advice is taken: then it does fit."""

import re

import numpy as np
import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.config import assign, preset
from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.files.checkpoint import load_checkpoint
from pp_cl.network.unet import UNet
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.scene.views import Photograph
from pp_cl.training.fitting import Room
from pp_cl.training.memory import GIB, MIB, memory_plan

GRID = Grid((-1, -1, -1), 0.02, (100, 100, 100))
HOST = "pp_cl.training.fitting.available_bytes"


@pytest.fixture
def plain(dev, monkeypatch):
    """A device of the test's own, in a machine with memory to spare."""
    monkeypatch.setattr(HOST, lambda: 2**45)
    made = Device(dev.device)
    made.info |= {"memory_bytes": 2**45, "max_allocation_bytes": 2**45}
    return made


def room(dev, base="tiny", images=20, size=(800, 600), **changes):
    """Room for a training with a narrow network."""
    config = preset(base)
    settings = {"network__widths": "16,16,16", "scene__downscale": "2"} | changes
    for key, value in settings.items():
        assign(config, key.replace("__", "."), value, "test")
    width, height = size
    camera = Camera(np.eye(3, 4), width, width, width / 2, height / 2, width, height)
    net = UNet(dev, widths=config.network.widths)
    return Room(config, net, [Photograph(f"{i}.png", camera) for i in range(images)])


def check(made):
    made.check_points(GRID, round(1.01 * made.sketch.config.points.count), (2, 6))


def refused(dev, **changes):
    """(what is too much, {option: value} of what is advised, the words)."""
    with pytest.raises(UserError) as caught:
        check(room(dev, **changes))
    text = str(caught.value)
    assert "\n" not in text
    problem, _, mend = text.rpartition(": ")
    values = {}
    for part in re.sub(" fits?(, in .*)?$", "", mend).split(" or "):
        key, value = part.removeprefix("--set ").replace(" ", "=").split("=")
        values[key] = value
    return problem, values, text


KEYS = {
    "--points": "points__count",
    "--downscale": "scene__downscale",
    "train.crop": "train__crop",
    "--memory": "train__memory_gib",
}


def taken(dev, advice, **changes):
    """Take every piece of the advice by itself: it must be accepted."""
    for key, value in advice.items():
        check(room(dev, **changes | {KEYS[key]: value}))


def planned(dev, **changes):
    made = room(dev, **changes)
    check(made)
    return made.plan


@pytest.mark.parametrize("base", ["tiny", "small", "full"])
def test_fewer_points_fit_a_smaller_device(plain, base):
    # small points, so that the least of a hull that is not known yet is close to what it takes
    changes = {"base": base, "raster__radius": "0.75"}
    needed = planned(plain, **changes).peak.device
    plain.info["memory_bytes"] = int(0.7 * needed)
    problem, advice, _ = refused(plain, **changes)
    assert problem.startswith("the training needs") and plain.name in problem
    asked = preset(base).points.count
    assert 0.5 * asked < int(advice["--points"]) < 0.75 * asked
    taken(plain, advice, **changes)
    # close to what fits: a fifth more does not
    with pytest.raises(UserError, match="the training needs"):
        check(room(plain, **changes, points__count=str(int(1.2 * int(advice["--points"])))))


def test_smaller_images_fit_where_the_network_is_too_large(plain):
    changes = {"train__crop": "0", "network__widths": "64,128,256", "points__count": "2000"}
    needed = planned(plain, **changes).peak.device
    plain.info["memory_bytes"] = int(0.7 * needed)
    _, advice, _ = refused(plain, **changes)
    assert advice.keys() == {"--downscale", "train.crop"}
    taken(plain, advice, **changes)
    plain.info["memory_bytes"] = int(0.2 * needed)  # less than a preview takes
    _, advice, _ = refused(plain, **changes)
    assert advice.keys() == {"--downscale"}
    taken(plain, advice, **changes)


def test_a_buffer_over_the_largest_allocation(plain):
    """As on a device that allocates 2 GiB at once: a quarter of all, or less."""
    changes = {"points__count": "12000000"}
    largest = planned(plain, **changes).largest
    assert largest[1] == 192 * round(1.01 * 12_000_000) > 2 * GIB
    plain.info["max_allocation_bytes"] = 2 * GIB
    problem, advice, _ = refused(plain, **changes)
    assert problem.startswith("a buffer of 2.17 GiB (points: sh") and "2.00 GiB" in problem
    assert advice["--points"] == "10000000"  # 2 GiB / 192 / 1.02, of two digits
    taken(plain, advice, **changes)


def test_a_device_of_four_gibibytes(plain):
    """All presets are refused with a way out, or planned for."""
    plain.info |= {"memory_bytes": 4 * GIB, "max_allocation_bytes": 2 * GIB}
    for base in ("tiny", "small"):
        check(room(plain, base=base))
    for base in ("full", "paper"):
        changes = {"base": base, "network__widths": "32,64,128", "scene__downscale": "1"}
        problem, advice, _ = refused(plain, **changes)
        assert "the training needs" in problem and "4.00 GiB" in problem
        taken(plain, advice, **changes)


def test_the_host_holds_the_images_and_a_cpus_buffers(plain, monkeypatch):
    changes = {"images": 300, "size": (4000, 3000), "scene__downscale": "1"}
    plan = planned(plain, **changes)
    assert plan.photographs == 300 * 48_000_000
    program = room(plain, **changes)._program
    monkeypatch.setattr(HOST, lambda: program + 2 * GIB)
    problem, advice, _ = refused(plain, **changes)
    assert "of the host's memory, 2.00 GiB are free" in problem
    assert advice.keys() == {"--downscale"} and int(advice["--downscale"]) <= 8
    taken(plain, advice, **changes)


def test_a_system_that_does_not_tell_what_is_free(plain, monkeypatch):
    monkeypatch.setattr(HOST, lambda: None)
    check(room(plain, images=300, size=(4000, 3000), scene__downscale="1"))


def test_two_settings_where_none_does_by_itself(plain):
    """Too little for the network of the whole image and for the points."""
    changes = {"train__crop": "32", "network__widths": "64,128,256", "scene__downscale": "1"}
    plain.info["memory_bytes"] = 150 * MIB
    with pytest.raises(UserError, match=r"--downscale (\d+) --points (\d+) fits$") as caught:
        check(room(plain, **changes))
    downscale, points = re.findall(r"--\w+ (\d+)", str(caught.value))
    check(room(plain, **changes | {"scene__downscale": downscale, "points__count": points}))


def test_nothing_fits(plain):
    plain.info["memory_bytes"] = MIB
    with pytest.raises(UserError, match="has 1 MiB: choose another device"):
        check(room(plain))


def test_the_memory_asked_for(plain):
    needed = planned(plain).peak.device / GIB
    changes = {"train__memory_gib": f"{0.8 * needed:.4f}"}
    problem, advice, _ = refused(plain, **changes)
    assert problem.startswith(f"--memory {changes['train__memory_gib']}: the training needs")
    assert needed <= float(advice["--memory"]) < needed + 0.02
    taken(plain, advice, **changes)
    check(room(plain, train__memory_gib="64"))
    check(room(plain))


def test_what_is_not_known_yet_refuses_no_more_than_it_must(plain):
    """Before the hull only the least is refused, with advice for the most."""
    made = room(plain)
    made.check_unseen()
    exact, filled = planned(plain).peak.device, memory_plan(made.sketch).peak.device
    assert made.plan.peak.device < exact < filled
    plain.info["memory_bytes"] = int(0.6 * exact)
    with pytest.raises(UserError) as caught:
        room(plain).check_unseen()
    points = re.search(r"--points (\d+)", str(caught.value))[1]
    other = room(plain, points__count=points)
    other.check_unseen()
    check(other)


def run(dev, monkeypatch, *words):
    """Status of a command on a device."""
    monkeypatch.setattr("pp_cl.device.discover.open_device", lambda choice: dev)
    return main(list(words))


@pytest.mark.slow
def test_the_advice_of_the_command_is_taken(plain, tmp_path, monkeypatch, capsys):
    """The device refuses what is more than it has, so that the plan cannot be too small."""
    scene = write_ball_scene(tmp_path / "ball", size=64)
    plain.info |= {"memory_bytes": 24 * MIB, "max_allocation_bytes": 8 * MIB}

    def train(points):
        return run(
            plain,
            monkeypatch,
            *arguments(scene, tmp_path / "run", points__count=points, train__iterations=25),
        )

    assert train(30_000) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and not (tmp_path / "run").exists()
    assert train(re.search(r"--points (\d+)", told)[1]) == 0
    assert plain.peak_bytes <= 24 * MIB


@pytest.mark.slow
def test_a_refinement_that_does_not_fit_keeps_what_is_learned(plain, tmp_path, monkeypatch, capsys):
    """More points are left than the plan took them to be."""
    scene = write_ball_scene(tmp_path / "ball", size=64)
    settings = {"train__refine_at": "0.5,1", "train__iterations": 40, "train__ema": "false"}
    settings |= {"train__prune_every": 1000, "train__checkpoint_every": 1000}
    monkeypatch.setattr(
        "pp_cl.training.memory.prunings", lambda train, start, end: int(end > start)
    )
    monkeypatch.setattr("pp_cl.training.memory.FIRST_KEPT", 0.05)
    plain.info["memory_bytes"] = 50 * MIB

    def train(name, points):
        words = arguments(scene, tmp_path / name, downscale=1, points__count=points, **settings)
        return run(plain, monkeypatch, *words)

    assert train("run", 5000) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert re.search(r"step 19: to go on with \d{4} points, the training needs", told)
    assert told.endswith("in another --out")
    assert load_checkpoint(tmp_path / "run/checkpoint.npz")[0]["step"] == 19
    assert train("smaller", re.search(r"--points (\d+)", told)[1]) == 0
    plain.info["memory_bytes"] = GIB
    assert train("run", 5000) == 0
