import io
import time
from types import SimpleNamespace

import pytest

from pp_cl import progress
from pp_cl.commands.progress import TrainingProgress

ROW = {"psnr": 27.314, "points": 1200}


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """Shortens intervals of seconds to hundredths."""
    monkeypatch.setattr(progress, "REDRAWN", 0.02)
    monkeypatch.setattr(progress, "LINES_APART", 0.02)
    monkeypatch.setattr(progress, "_told", 0.0)
    monkeypatch.setattr(progress, "_shown", None)
    monkeypatch.setenv("COLUMNS", "120")


def until(stream, text):
    end = time.monotonic() + 10
    while text not in stream.getvalue():
        assert time.monotonic() < end, stream.getvalue()
        time.sleep(0.01)


def test_in_a_log_a_stage_has_lines_also_within_one_long_call():
    stream = io.StringIO()
    for pair in progress.track([1, 2, 3], "matching", "pair", stream=stream):
        until(stream, f"matching: {pair - 1} of 3 pairs, ")
    lines = stream.getvalue().splitlines()
    assert "\r" not in stream.getvalue() and "\x1b" not in stream.getvalue()
    assert lines[0].endswith(" so far") and lines[-1].endswith(" left")


def test_a_stage_of_unknown_length_tells_its_time():
    stream = io.StringIO()
    with progress.Progress("carving the visual hull", stream=stream):
        until(stream, "carving the visual hull: 00:00 so far\n")


def test_lines_of_all_stages_have_their_distance(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(progress, "LINES_APART", 0.5)
    monkeypatch.setattr(progress, "_told", time.monotonic())
    for _ in range(20):  # each stage is shorter than the distance between lines
        with progress.Progress("reading", stream=stream):
            time.sleep(0.06)
    assert 1 <= stream.getvalue().count("\n") <= 3


def test_a_stream_that_fails_ends_no_stage():
    stream = io.StringIO()
    stream.close()
    stream.isatty = lambda: False
    with progress.Progress("reading", 2, "image", stream=stream) as bar:
        time.sleep(0.1)
        bar.update()


def test_on_a_terminal_a_bar_moves_by_itself():
    stream = Terminal()
    with progress.Progress("matching", 3, "pair", stream=stream) as bar:
        bar.update()
        until(stream, "matching:  33%")
        bar.note = "all well"
        until(stream, "all well")
    assert "\n" not in stream.getvalue()


def test_nothing_is_shown_within_another_stage():
    stream, within = io.StringIO(), io.StringIO()
    with progress.Progress("training", stream=stream):
        for _ in progress.track([1, 2], "colours", "view", stream=within):
            until(stream, "training: ")
    with progress.Progress("colours", stream=within):
        until(within, "colours: ")
    assert within.getvalue().count("view") == 0


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
def test_of_given_minutes_those_left_are_told(kind):
    stream = kind()
    with progress.Progress("training", given=2.0, done=30, stream=stream) as bar:
        until(stream, "1.5 of 2.0 minutes left")
        bar.note = "step 7"
        until(stream, "minutes left, step 7")
    assert kind is io.StringIO or "training:  25%" in stream.getvalue()
    with progress.Progress("training", given=2.0, done=200, stream=stream):
        until(stream, "0.0 of 2.0 minutes left")


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
def test_a_training_tells_its_rate_points_and_memory(kind):
    trainer = SimpleNamespace(step=100, dev=SimpleNamespace(bytes=3 * 2**29))
    train = SimpleNamespace(iterations=400, minutes=0, members=1)
    config = SimpleNamespace(train=train)
    stream, training = kind(), SimpleNamespace(trainer=trainer, config=config, clock=None)
    with TrainingProgress(training, stream) as follower:
        until(stream, "building kernels (once): 00:0")
        follower(101, None)
        follower(102, None)
        until(stream, "102 of 400" if kind is io.StringIO else "102/400")
        follower(103, ROW | {"test_psnr": 25.5})
        follower(104, ROW)
        until(stream, "PSNR 27.31 (test 25.50), 1200 points, 1.50 GiB")
        until(stream, "training: 104 of 400 steps" if kind is io.StringIO else "104/400")


def test_a_training_by_minutes_tells_how_many_steps_they_allow():
    trainer = SimpleNamespace(step=0, steps=250.4, dev=SimpleNamespace(bytes=0))
    config = SimpleNamespace(
        train=SimpleNamespace(iterations=8000, minutes=2.5, members=1), preset="small"
    )
    training = SimpleNamespace(trainer=trainer, config=config, clock=True, passed=0.0)
    stream = io.StringIO()
    with TrainingProgress(training, stream) as follower:
        for step in range(1, 14):
            follower(step, None)
    told = "2.5 min: small, 250 steps at this pace (its own are 6000); with fewer than 1000 it"
    assert (
        f"{told} stays blurred: it needs some 10 minutes, or a smaller --preset"
        in stream.getvalue()
    )
