"""A run of several trainings shows the mean of their images."""

import json
import shutil

import numpy as np
import pytest
from support.runs import arguments, checkpoint

from pp_cl.cli import main
from pp_cl.engine.step import Trainer
from pp_cl.evaluate import evaluate_run
from pp_cl.run import load

SETTINGS = {"train__iterations": 20, "train__checkpoint_every": 5, "train__members": 2}


@pytest.fixture(scope="module")
def both(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("members") / "run"
    assert main(arguments(scene, out, **SETTINGS)) == 0
    return out


def test_each_member_is_a_training_of_its_own_seed(scene, both, tmp_path):
    alone = tmp_path / "alone"
    assert main(arguments(scene, alone, train__iterations=20, train__seed=1)) == 0
    assert checkpoint(both / "member-2") == checkpoint(alone)
    assert checkpoint(both) != checkpoint(alone)
    seeds = [
        json.loads((run / "config.json").read_text())["train"]["seed"]
        for run in (both, both / "member-2")
    ]
    assert seeds == [0, 1]


def test_the_mean_of_their_images_is_shown(both, dev):
    run, second = load(both, dev), load(both / "member-2", dev)
    camera = run.cameras()[0]
    colour = run.render(camera).colour
    alone = [member.renderer.render(camera, member.gamma) for member in (run, second)]
    np.testing.assert_allclose(colour, np.mean(alone, 0), atol=1e-6)
    assert np.abs(alone[0] - alone[1]).max() > 0.01
    mean = evaluate_run(run, metrics=("psnr",))["mean"]["psnr"]
    own = [evaluate_run(load(both / "member-2", dev), metrics=("psnr",))["mean"]["psnr"]]
    assert mean > own[0]


def test_it_resumes_in_either_member(scene, both, tmp_path, monkeypatch, capsys, dev):
    out, train_step = tmp_path / "run", Trainer.train_step
    for seed, step in ((0, 7), (1, 12)):

        def stopping(trainer, seed=seed, step=step):
            if (trainer.config.train.seed, trainer.step) == (seed, step):
                raise KeyboardInterrupt
            return train_step(trainer)

        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "train_step", stopping)
            assert main(arguments(scene, out, **SETTINGS)) == 130
    assert not load(out, dev).others  # the second member is not finished
    assert main(arguments(scene, out, **SETTINGS)) == 0
    assert checkpoint(out) == checkpoint(both)
    assert checkpoint(out / "member-2") == checkpoint(both / "member-2")
    assert len(load(out, dev).others) == 1
    capsys.readouterr()
    assert main(arguments(scene, out, **SETTINGS)) == 0
    assert capsys.readouterr().out.count("is finished") == 2


def test_a_longer_run_ends_an_unfinished_member_before_it_extends_it(
    scene, both, tmp_path, monkeypatch
):
    longer, train_step = SETTINGS | {"train__iterations": 30}, Trainer.train_step
    whole, killed = (shutil.copytree(both, tmp_path / name) for name in ("whole", "killed"))
    shutil.rmtree(killed / "member-2")

    def stopping(trainer):
        if (trainer.config.train.seed, trainer.step) == (1, 12):
            raise KeyboardInterrupt
        return train_step(trainer)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train_step", stopping)
        assert main(arguments(scene, killed, **SETTINGS)) == 130
    for out in (whole, killed):
        assert main(arguments(scene, out, **longer)) == 0
    assert checkpoint(killed / "member-2") == checkpoint(whole / "member-2")
