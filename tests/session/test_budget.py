import json
import signal
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.runs import SETTINGS, set_words, spoken

from pp_cl.cli import main
from pp_cl.engine.step import Trainer
from pp_cl.engine.training.schedule import refine_steps, supersampling_at
from pp_cl.engine.training.specular import fit_steps
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.budget import FITTING, Budget
from pp_cl.session.plan import NEVER
from pp_cl.settings import Config, TrainConfig

SMALL = {key: value for key, value in SETTINGS.items() if key != "train.iterations"}


def simulated(minutes, refine_at, seconds_of, built=0.0, supersampled=0.0):
    """Simulate a training whose steps take seconds_of(share of the steps done, refinements done),
    after `built` seconds for kernels. Returns (seconds, its TrainConfig, steps of its refinements).
    """
    train = TrainConfig(
        iterations=8000, minutes=minutes, refine_at=refine_at, supersampled=supersampled
    )
    config, step, total, refined = Config(train=train), 0, 0.0, []
    budget = Budget(config, 48 * 200**2)
    while step < train.iterations:
        took = seconds_of(step / train.iterations, len(refined)) + built * (step == 0)
        took *= supersampling_at(step, train)
        step, total = step + 1, total + took
        refined += [step] if step in refine_steps(train) else []
        if plan := budget.plan(config, step, total):
            config = plan.settings(config)
            train = config.train
        assert [at for at in refine_steps(train) if at <= step] == refined
    total += FITTING * fit_steps(train.iterations) + 53 * seconds_of(1.0, len(refined))
    return total, train, refined


@pytest.mark.parametrize("minutes, supersampled", [(1, 0), (1, 0.3), (5, 0), (60, 0), (60, 0.3)])
@pytest.mark.parametrize("refine_at", [(1.0, 1.0), (0.35, 1.0), (0.33, 0.67)])
@pytest.mark.parametrize("dearer", [1.7, 2.3, 3.0])
def test_the_promise_is_kept_as_fog_clears_and_grids_are_refined(
    minutes, supersampled, refine_at, dearer
):
    rng = np.random.default_rng(1)

    def seconds_of(share, level):  # fog slows the first steps; others use the machine
        busy = 2.0 if 0.5 < share < 0.6 else 1.0
        return 0.05 * dearer**level * (1 + np.exp(-9 * share)) * busy * rng.uniform(0.5, 1.5)

    total, train, refined = simulated(minutes, refine_at, seconds_of, 10.0, supersampled)
    assert 0.8 * 60 * minutes < total < 1.15 * 60 * minutes
    if minutes > 1:  # in one minute nothing is pruned between two refinements
        assert len(refined) == sum(share < 1 for share in refine_at)
    shares = [step / train.iterations for step in refined]
    most = 0.25 if supersampled else 0.2  # supersampled steps come later, and their time is a guess
    assert all(abs(share - asked) < most for share, asked in zip(shares, refine_at, strict=False))


def test_what_comes_before_the_first_step_is_in_the_minutes():
    config = Config(train=TrainConfig(iterations=8000, minutes=2, refine_at=(1.0, 1.0)))
    budget = Budget(config, 0)
    for step in range(1, 11):
        plan = budget.plan(config, step, 60 + 0.1 * step)  # 60 s of reading, carving and building
    assert 600 < plan.iterations < 1000  # the plan expects faster steps once fog has cleared
    assert config.train.iterations == 8000


@pytest.mark.parametrize("step, is_refined", [(0.05, True), (1.0, False)])
def test_few_steps_are_better_without_refinement(step, is_refined):
    config = Config(train=TrainConfig(iterations=6000, minutes=5, refine_at=(0.35, 1.0)))
    budget = Budget(config, 48 * 200**2, may_stay_coarse=True)
    for number in range(1, 200):
        if plan := budget.plan(config, number, number * step):
            config = plan.settings(config)
            assert is_refined or plan.refine_at == NEVER
    assert bool(refine_steps(config.train)) == is_refined
    assert config.train.iterations < 1000 or is_refined


@pytest.mark.parametrize("minutes, refinements", [(1, 0), (8, 1), (60, 2)])
def test_a_refinement_with_too_few_steps_is_left_out(minutes, refinements):
    train = TrainConfig(minutes=minutes, refine_at=(0.33, 0.67), supersampled=0.25, crop=256)
    config, step, total, made = Config(train=replace(train, iterations=22000)), 0, 0.0, 0
    budget = Budget(config, 100 * 800**2, may_stay_coarse=True)
    seconds = {(0, 2): 0.03, (0, 1): 0.05, (0, 0): 0.1, (1, 1): 0.12, (1, 0): 0.13, (2, 0): 0.26}
    while step < config.train.iterations:  # of `full`, by refinements made and to come
        took = seconds[made, sum(step < at for at in refine_steps(config.train))]
        took *= supersampling_at(step, config.train)
        step, total = step + 1, total + took * (1 + 0.4 * np.exp(-9 * step / 22000))
        made += step in refine_steps(config.train)
        if plan := budget.plan(config, step, total):
            config = plan.settings(config)
    assert made == refinements
    total += FITTING * fit_steps(config.train.iterations) + 440 * seconds[made, 0]
    assert 0.75 * 60 * minutes < total < 1.1 * 60 * minutes


def test_a_training_without_time_ends_soon_and_in_order():
    _, train, refined = simulated(0.01, (0.33, 0.67), lambda share, level: 1.0)
    assert train.iterations < 60 and refined
    assert list(train.refine_at) == sorted(train.refine_at)


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
    for stopped_at in (5, 30, 100):

        def stepping(self, at=stopped_at):
            if self.step + 1 == at:
                signal.raise_signal(signal.SIGINT)
            return train_step(self)

        monkeypatch.setattr(Trainer, "train_step", stepping)
        assert main(words) == 130
    planned = json.loads(folder.config.read_text())
    planned["train"]["supersampled"] = 0.2  # a value that a plan may have chosen
    folder.config.write_text(json.dumps(planned))
    assert main(words) == 0
    train, last = json.loads(folder.config.read_text())["train"], folder.rows()[-1]
    assert last["finished"] and 4.5 < last["seconds"] < 7.5  # the steps take half of the time
    assert last["step"] == train["iterations"] and train["minutes"] == 0.2
    (refined,) = refine_steps(TrainConfig(**train))
    assert 0.15 < refined / last["step"] < 0.6
    points = {row["step"]: row["points"] for row in folder.rows()}
    assert points[refined // 5 * 5] < 600 < points[-(-refined // 5) * 5 + 5]
    status, lines = spoken(words)
    assert status == 0 and not lines  # the run is finished without warnings
    status, (line,) = spoken([*words, "--iterations", "9"])
    assert status == 2 and "--minutes" in line
