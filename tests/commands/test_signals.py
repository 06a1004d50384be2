"""Ctrl-C and SIGTERM: the step is finished and a checkpoint written."""

import signal

import pytest
from support.checkpoints import load_checkpoint
from support.runs import arguments

from pp_cl.cli import main
from pp_cl.commands.signals import first_signal
from pp_cl.engine.step import Trainer


@pytest.fixture(scope="module")
def whole(finished):
    """The checkpoint of a training that was not stopped."""
    return (finished / "checkpoint.npz").read_bytes()


def signalling(monkeypatch, at, number):
    """Trainer.train_step that sends this process a signal in the middle of a step."""
    train_step = Trainer.train_step

    def stepping(self):
        if self.step + 1 == at:
            signal.raise_signal(number)
        return train_step(self)

    monkeypatch.setattr(Trainer, "train_step", stepping)


@pytest.mark.parametrize(
    "steps, number, status", [(3, signal.SIGINT, 130), (47, signal.SIGTERM, 143)]
)
def test_a_signal_ends_the_step_and_the_run_goes_on_to_the_same_bytes(
    scene, whole, tmp_path, capsys, monkeypatch, steps, number, status
):
    out, before = tmp_path / "run", signal.getsignal(number)
    with monkeypatch.context() as patch:
        signalling(patch, steps, number)
        assert main(arguments(scene, out)) == status
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pp-cl: ")]
    assert len(told) == 1 and "the same command goes on" in told[0] and f"step {steps};" in told[0]
    header, _ = load_checkpoint(out / "checkpoint.npz")
    assert header["step"] == steps and not header["finished"]
    assert signal.getsignal(number) is before
    assert main(arguments(scene, out)) == 0
    assert (out / "checkpoint.npz").read_bytes() == whole


def test_a_signal_in_the_last_step_changes_nothing(scene, whole, tmp_path, monkeypatch):
    signalling(monkeypatch, 60, signal.SIGINT)
    assert main(arguments(scene, tmp_path / "run")) == 0
    assert (tmp_path / "run" / "checkpoint.npz").read_bytes() == whole


@pytest.mark.parametrize("at, saved", [(25, 20), (1, None)])
def test_a_second_signal_stops_at_once(scene, tmp_path, capsys, monkeypatch, at, saved):
    """Both come in a step; what is promised is the last checkpoint, where there is one."""
    train_step, file = Trainer.train_step, tmp_path / "run" / "checkpoint.npz"

    def stepping(self):
        if self.step + 1 == at:
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
        return train_step(self)

    monkeypatch.setattr(Trainer, "train_step", stepping)
    assert main(arguments(scene, tmp_path / "run")) == 130
    *_, line = capsys.readouterr().err.splitlines()
    assert ("goes on from" if saved else "starts over") in line
    assert load_checkpoint(file)[0]["step"] == saved if saved else not file.exists()


def test_other_commands_promise_nothing(capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("pp_cl.commands.compare.run", interrupted)
    assert main(["compare", "a", "b"]) == 130
    assert capsys.readouterr().err == "pp-cl: interrupted\n"


def test_ignored_signals_stay_ignored(monkeypatch):
    """nohup and & in a script rely on it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with first_signal() as caught:
            signal.raise_signal(signal.SIGINT)
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN and not caught
    finally:
        signal.signal(signal.SIGINT, before)
