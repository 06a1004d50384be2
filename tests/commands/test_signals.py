import signal
import subprocess
import sys
import time
from textwrap import dedent

import pytest
from support.checkpoints import load_checkpoint
from support.runs import arguments

from pp_cl.cli import main
from pp_cl.commands.signals import PATIENCE, STOPPING, first_signal
from pp_cl.engine.step import Trainer
from pp_cl.errors import UserError


@pytest.fixture(scope="module")
def whole(finished):
    return (finished / "checkpoint.npz").read_bytes()


def signalling(monkeypatch, at, number):
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
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pp-cl: ")]
    assert (
        len(lines) == 1 and "the same command goes on" in lines[0] and f"step {steps};" in lines[0]
    )
    header, _ = load_checkpoint(out / "checkpoint.npz")
    assert header["step"] == steps and not header["finished"]
    assert signal.getsignal(number) is before
    assert main(arguments(scene, out)) == 0
    assert (out / "checkpoint.npz").read_bytes() == whole


def test_a_signal_in_the_last_step_changes_nothing_but_the_status(
    scene, whole, tmp_path, capsys, monkeypatch
):
    """A command that trains first, such as make, ends there."""
    signalling(monkeypatch, 60, signal.SIGINT)
    assert main(arguments(scene, tmp_path / "run")) == 130
    assert "; the training is finished" in capsys.readouterr().err.splitlines()[-1]
    assert (tmp_path / "run" / "checkpoint.npz").read_bytes() == whole


@pytest.mark.parametrize("at, saved, status", [(25, 20, 130), (1, None, 143)])
def test_a_second_signal_stops_at_once_and_so_does_one_in_the_first_step(
    scene, tmp_path, capsys, monkeypatch, at, saved, status
):
    """Only the last checkpoint is promised, if there is one. The first step builds kernels for half
    a minute, and waiting for them would save nothing.
    """
    train_step, file = Trainer.train_step, tmp_path / "run" / "checkpoint.npz"

    def stepping(self):
        if self.step + 1 == at:
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
        return train_step(self)

    monkeypatch.setattr(Trainer, "train_step", stepping)
    assert main(arguments(scene, tmp_path / "run")) == status
    *_, line = capsys.readouterr().err.splitlines()
    assert ("goes on from" if saved else "starts over") in line
    assert load_checkpoint(file)[0]["step"] == saved if saved else not file.exists()


@pytest.mark.parametrize("number", STOPPING)
def test_what_follows_from_a_signal_is_not_told(capsys, monkeypatch, number):
    """The signal also ended another process, or interrupted an import."""

    def broken(*_):
        try:
            signal.raise_signal(number)
        finally:
            raise UserError("ffmpeg ended")

    before = signal.getsignal(number)
    monkeypatch.setattr("pp_cl.commands.compare.run", broken)
    assert main(["compare", "a", "b"]) == 128 + number
    assert capsys.readouterr().err == "pp-cl: interrupted\n"
    assert signal.getsignal(number) is before


@pytest.mark.unix
@pytest.mark.parametrize("number", STOPPING)
def test_a_process_ends_soon_whatever_it_is_doing(number):
    """Handlers do not run while the process waits for a lock, which no signal interrupts, or a
    compiler.
    """
    code = """
        import ctypes, sys
        from pp_cl import cli
        from pp_cl.commands import compare
        def run(_):
            print(flush=True)
            while True:
                try:
                    ctypes.CDLL(None).sleep(1000)
                except KeyboardInterrupt:
                    pass
        compare.run = run
        sys.exit(cli.program(["compare", "a", "b"]))
    """
    with subprocess.Popen(
        [sys.executable, "-c", dedent(code)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "\n"
        start = time.monotonic()
        process.send_signal(number)
        assert process.stderr.read() == "pp-cl: interrupted\n"
        assert process.wait() == 128 + number and time.monotonic() - start < PATIENCE + 2


def test_ignored_signals_stay_ignored(monkeypatch):
    """Scripts with nohup and & rely on it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with first_signal() as caught:
            signal.raise_signal(signal.SIGINT)
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN and not caught
    finally:
        signal.signal(signal.SIGINT, before)
