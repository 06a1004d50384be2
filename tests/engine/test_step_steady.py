"""A training step in its steady state: the device is waited for once, and nothing is allocated."""

import collections
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest
from support.models import drawn_alone

import pp_cl.engine.network.unet
from pp_cl.config import configure, preset
from pp_cl.engine.device.buffers import Pending
from pp_cl.engine.device.device import Device
from pp_cl.engine.training import between
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.training import open_training

MOST_LAUNCHES = 64  # in a step of tiny; each takes the host 30 us
COMPLETE = cl.command_execution_status.COMPLETE
EVERY_STEP = {  # so that every step does the work of most steps
    "points.count": 300,
    "train.iterations": 1000,
    "train.prune_every": 900,
    "train.sh_smoothing": 0,
}
SETTINGS = {
    "tiny": {},
    "tiny, ignored pixels": {},
    "paper": {"network.widths": (16, 16, 16)},
    "paper, crops": {"network.widths": (16, 16, 16), "train.crop": 24},
}


def make_trainer(dev, scene, folder, name):
    settings = EVERY_STEP | SETTINGS[name]
    config = configure(
        preset(name.partition(",")[0]), str(scene), [(k, v, "test") for k, v in settings.items()]
    )
    trainer = open_training(dev, RunFolder(folder), config, None).trainer
    if "ignored" in name:
        hand = np.zeros(trainer.views[0].image.shape[:2], bool)
        hand[:9, :9] = True
        trainer.views[:] = [replace(view, ignored=hand) for view in trainer.views]
    return trainer


class Recorder:
    """Counts waits for the device, launches and allocations."""

    def __init__(self, monkeypatch):
        self.counts = collections.Counter()
        self._follow(monkeypatch, cl, "enqueue_copy", self._copies)
        self._follow(monkeypatch, Device, "_allocate", "allocations")
        self._follow(monkeypatch, Device, "finish", "waits")
        self._follow(monkeypatch, Device, "enqueue", "launches")
        self._follow(monkeypatch, Pending, "get", self._gets)

    def _follow(self, monkeypatch, owner, name, counted):
        original = getattr(owner, name)

        def follow(*args, **named):
            self.counts[counted if isinstance(counted, str) else counted(*args, **named)] += 1
            return original(*args, **named)

        monkeypatch.setattr(owner, name, follow)

    @staticmethod
    def _copies(queue, target, source, is_blocking=True, **_):
        on_device = isinstance(target, cl.Buffer) and isinstance(source, cl.Buffer)
        return "waits" if is_blocking and not on_device else "copies"

    @staticmethod
    def _gets(pending):
        event = pending._event
        there = event is None or event.command_execution_status == COMPLETE
        return "read" if there else "waits"


@pytest.mark.parametrize(
    "name, planned",
    [
        ("tiny", False),
        ("tiny, ignored pixels", False),
        ("paper", False),
        ("paper, crops", True),
    ],
)
def test_a_step_waits_once_and_allocates_nothing(dev, scene, tmp_path, monkeypatch, name, planned):
    """planned: background tiles are left out, as in large images."""
    if planned:
        monkeypatch.setattr(pp_cl.engine.network.unet, "LEAST_PIXELS", 0)
        monkeypatch.setattr(pp_cl.engine.network.unet, "MOST_COMPUTED", 2)
    trainer = make_trainer(dev, scene, tmp_path / "run", name)
    for _ in range(12):
        trainer.train_step()
    dev.finish()
    with monkeypatch.context() as patched:
        recorder = Recorder(patched)
        for step in range(1, 6):
            trainer.train_step()
            assert recorder.counts["waits"] <= step, recorder.counts
    assert recorder.counts["allocations"] == 0, recorder.counts
    if name == "tiny" and not planned and dev.is_cpu:
        assert recorder.counts["launches"] <= 5 * MOST_LAUNCHES
    assert recorder.counts["read"] > 0


def test_the_end_holds_no_view_beside_another(dev, scene, tmp_path, monkeypatch):
    """Nor does it hold one when it moves rows of points, the largest arrays of a training."""
    trainer = make_trainer(dev, scene, tmp_path / "run", "tiny")
    drawn, keep = drawn_alone(monkeypatch, trainer.renderer), between.keep

    def keeping(trainer, rows):
        assert not any(view() for view in drawn)
        keep(trainer, rows)

    monkeypatch.setattr(between, "keep", keeping)
    trainer.finish()
    assert len(drawn) == 2 * len(trainer.views)  # to prune, and to fit the specular layer
