import json
import signal
from types import SimpleNamespace

import numpy as np
import pytest
from support.checkpoints import load_checkpoint
from support.runs import SETTINGS, set_words, spoken

from pp_cl.cli import main
from pp_cl.engine.step import Trainer
from pp_cl.engine.training.schedule import growths, has_passed, refinements, supersampling_at
from pp_cl.engine.training.specular import fit_steps
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.clock import FEWEST, MEASURED_AT, RESERVED, Clock, seconds_after
from pp_cl.session.decide import PAYS_FROM
from pp_cl.settings import TrainConfig

SMALL = {key: value for key, value in SETTINGS.items() if key != "train.iterations"}


def simulated(minutes, refine_at, seconds_of, built=0.0, supersampled=0.0, ending=0.0):
    """Simulate a training whose steps take seconds_of(progress, refinements done), after `built`
    seconds for kernels, and what follows them `ending` seconds. Returns (seconds, progresses at
    which it was refined, its Clock).
    """
    train = TrainConfig(minutes=minutes, refine_at=refine_at, supersampled=supersampled)
    step, total, refined = 0, 0.0, []
    clock = Clock(60 * minutes, lambda: total, 0.0, 8000)
    while clock.progress < 1:
        before = clock.progress
        took = seconds_of(before, len(refined)) + built * (step < 2) / 2
        step, total = step + 1, total + took * 1.3 ** (supersampling_at(before, train) == 2)
        clock(step)
        assert before <= clock.progress <= 1
        if any(has_passed(share, before, clock.progress) for share in growths(train)):
            made = [share for share in refinements(train) if share <= before]
            due = any(has_passed(share, before, clock.progress) for share in refinements(train))
            if due and clock.steps_left >= PAYS_FROM[min(len(made), 1)]:
                refined.append(clock.progress)
            clock.begins_anew()
        if has_passed(MEASURED_AT, before, clock.progress):
            clock.reserve(ending)
    return total + ending, refined, clock


@pytest.mark.parametrize("minutes", [1, 5, 60])
@pytest.mark.parametrize(
    "refine_at, supersampled", [((1, 1), 0), ((0.35, 1), 0.3), ((0.33, 0.67), 0)]
)
@pytest.mark.parametrize("dearer", [1.7, 3.0])
@pytest.mark.parametrize("ending", [0.0, 0.15])
def test_minutes_are_kept_as_fog_clears_and_grids_are_refined(
    minutes, refine_at, supersampled, dearer, ending
):
    rng = np.random.default_rng(1)

    def seconds_of(progress, level):  # fog slows the first steps; others use the machine
        busy = 2.0 if 0.5 < progress < 0.6 else 1.0
        return 0.02 * dearer**level * (1 + np.exp(-9 * progress)) * busy * rng.uniform(0.5, 1.5)

    after = 60 * minutes * ending
    total, refined, _ = simulated(minutes, refine_at, seconds_of, 10.0, supersampled, after)
    assert 0.97 * 60 * minutes < total < 1.01 * 60 * minutes
    asked = [share for share in refine_at if share < 1]
    made = len(asked) if minutes == 60 else len(refined)  # for others there may be too little time
    assert refined == pytest.approx(asked[:made], abs=0.01)


def test_kernels_are_built_at_the_beginning_of_the_schedules():
    now = [60.0]  # seconds of reading and carving
    clock = Clock(120, lambda: now[0], 0.0, 8000)
    for step, took in enumerate([20, 9, 0.1, 0.1], 1):
        now[0] += took
        progress = clock(step)
    left = 120 * (1 - RESERVED) - 89
    assert progress == pytest.approx(0.2 / left, rel=0.01)
    assert clock.steps == pytest.approx(2 + left / 0.1, rel=0.01)


@pytest.mark.parametrize(
    "seconds, refinements", [(0.3, 0), (0.1, 1), (0.003, 2)], ids=["none", "one", "both"]
)
def test_a_refinement_with_too_little_time_is_left_out(seconds, refinements):
    """In five minutes, by what a step takes when one is due."""

    def seconds_of(progress, level):
        return seconds * 2.3**level

    total, refined, _ = simulated(5, (0.33, 0.67), seconds_of)
    assert len(refined) == refinements and 0.97 * 300 < total < 1.01 * 300


def test_a_training_without_time_ends_soon_and_in_order():
    total, _, clock = simulated(0.01, (0.33, 0.67), lambda progress, level: 1.0)
    assert clock.progress == 1 and total <= FEWEST + 2


def test_what_follows_the_last_step_is_reserved_as_it_was_measured():
    train = TrainConfig(prune_weight=0.05, specular="auto")
    seconds = seconds_after(train, views=300, image=0.1, steps=8000)
    assert seconds == pytest.approx(0.1 * (0.5 * 300 + 128) + fit_steps(8000) / 150)
    neither = TrainConfig(prune_weight=0, specular="off")
    assert seconds_after(neither, views=300, image=0.1, steps=8000) == 0


@pytest.fixture
def clock(monkeypatch):
    """A clock that advances by 50 ms at each look, so a step takes 50 ms."""
    now = [0.0]

    def perf_counter():
        now[0] += 0.05
        return now[0]

    monkeypatch.setattr(
        "pp_cl.session.training.time",
        SimpleNamespace(perf_counter=perf_counter, monotonic=lambda: now[0]),
    )
    return now


def test_a_run_takes_its_minutes_however_often_it_is_stopped(scene, tmp_path, clock, monkeypatch):
    words = ["train", scene, "--out", str(tmp_path / "run"), "--minutes", "0.2"]
    words += set_words(
        SMALL,
        train__refine_at="0.35,1",
        points__count=300,
        train__supersampled=0.25,
        train__specular="off",  # it would take a third of the few seconds
    )
    folder, train_step = RunFolder(tmp_path / "run"), Trainer.train_step
    for stopped_at in (2, 5, 30, 100):

        def stepping(self, at=stopped_at):
            if self.step + 1 == at:
                signal.raise_signal(signal.SIGINT)
            return train_step(self)

        monkeypatch.setattr(Trainer, "train_step", stepping)
        assert main(words) == 130
        assert load_checkpoint(folder.checkpoint)[0]["passed"] == pytest.approx(clock[0], abs=0.1)
    assert main(words) == 0
    train, last = json.loads(folder.config.read_text())["train"], folder.rows()[-1]
    assert last["finished"] and 4.5 < last["seconds"] < 7.5  # the steps take half of the time
    assert last["step"] == train["iterations"] and train["minutes"] == 0.2
    refined = next(row["step"] for row in folder.rows() if row["points"] > 600)
    assert 0.25 < refined / last["step"] < 0.5
    status, lines = spoken(words)
    assert status == 0 and not lines  # the run is finished without warnings
    status, (line,) = spoken([*words, "--iterations", "9"])
    assert status == 2 and "--minutes" in line
