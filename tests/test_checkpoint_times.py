import time
from types import SimpleNamespace

import pytest
from support.runs import arguments, checkpoint

from pp_cl.checkpoint import save_checkpoint
from pp_cl.cli import main
from pp_cl.engine.step import Trainer


@pytest.fixture
def saved(monkeypatch):
    """The steps at which checkpoints are written while every step takes a minute."""
    steps, now, train_step = [], [0.0], Trainer.train_step

    def saving(path, header, arrays):
        steps.append(header["step"])
        save_checkpoint(path, header, arrays)

    def stepping(self):
        now[0] += 60
        return train_step(self)

    clock = SimpleNamespace(monotonic=lambda: now[0], perf_counter=time.perf_counter)
    monkeypatch.setattr("pp_cl.session.training.time", clock)
    monkeypatch.setattr("pp_cl.session.training.save_checkpoint", saving)
    monkeypatch.setattr(Trainer, "train_step", stepping)
    return steps


@pytest.mark.parametrize(
    "every, minutes, expected",
    [
        (1000, 7.5, [8, 16, 24, 32, 40, 48, 56, 60]),
        # each checkpoint restarts the count of minutes
        (10, 7.5, [8, 10, 18, 20, 28, 30, 38, 40, 48, 50, 58, 60]),
    ],
)
def test_minutes_and_steps_say_when_and_the_bytes_are_the_same(
    scene, finished, saved, tmp_path, every, minutes, expected
):
    changes = {"train__checkpoint_every": every, "train__checkpoint_minutes": minutes}
    assert main(arguments(scene, tmp_path / "run", **changes)) == 0
    assert saved == expected
    assert checkpoint(tmp_path / "run") == checkpoint(finished)
