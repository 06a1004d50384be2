"""What a training shows while it runs, on a terminal and elsewhere."""

import io
from types import SimpleNamespace

import pytest

from pp_cl.commands import progress

ROW = {"psnr": 27.314, "points": 1200}


class Terminal(io.StringIO):
    """Text that is shown to somebody."""

    def isatty(self):
        return True


@pytest.fixture
def training():
    """A training of 400 steps of which 100 are done, on a device that uses 1.5 GiB."""
    trainer = SimpleNamespace(step=100, dev=SimpleNamespace(bytes=3 * 2**29))
    config = SimpleNamespace(train=SimpleNamespace(iterations=400))
    return SimpleNamespace(trainer=trainer, config=config)


def shown(training, stream, monkeypatch):
    """What 300 steps print that take a second each, the first two of them a minute, and of which
    every tenth has a row.
    """
    now = [1000.0]
    monkeypatch.setattr("pp_cl.commands.progress.time.monotonic", lambda: now[0])
    monkeypatch.setenv("COLUMNS", "120")  # the rate, as tqdm measures it, has any number of digits
    with progress.Progress(training, stream) as follower:
        for step in range(101, 401):
            now[0] += 1 if step > 102 else 60
            test = {"test_psnr": 25.5} if step == 200 else {}
            follower(step, ROW | test if step % 10 == 0 else None)
    return stream.getvalue()


def test_elsewhere_there_is_a_plain_line_every_30_seconds(training, monkeypatch):
    text = shown(training, io.StringIO(), monkeypatch)
    lines = text.splitlines()
    assert "\r" not in text and "\x1b" not in text
    assert lines.pop(0) == "building kernels (once)"
    assert [int(line.split()[1]) for line in lines] == list(range(110, 401, 30))
    assert lines[0] == ("step 110 of 400, 1 steps/s, 04:50 left, PSNR 27.31, 1200 points, 1.50 GiB")
    assert "PSNR 27.31 (test 25.50), 1200" in lines[3]
    assert "00:20 left" in lines[-1]


def test_a_terminal_has_one_line(training, monkeypatch):
    monkeypatch.setattr("pp_cl.commands.progress.REDRAWN", 0)
    text = shown(training, Terminal(), monkeypatch)
    assert text.startswith("building kernels (once)\n")
    assert text.count("\n") == 2 and text.endswith("\n")
    last = text.rstrip("\n").rpartition("\r")[2]
    assert last.startswith("100%|") and " 400/400, " in last and "step/s, 00:00 left" in last
    assert last.rstrip().endswith(", PSNR 27.31 (test 25.50), 1200 points, 1.50 GiB")
