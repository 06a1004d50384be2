"""How a command shows that it goes on: one line on a terminal, elsewhere now and then a line."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from tqdm import tqdm

from pp_cl.session import Training

BUILDING = 2  # steps in which nearly all kernels are built, if the driver has not kept them
TOLD = "building kernels (once)"
REDRAWN = 1  # seconds, at least, between two states of the bar
LINES_APART = 30  # seconds, at least, between the lines in a file
GIB = 2**30
# tqdm's, with little beside what follows; it is cut off at the right border
FORMAT = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}, {rate_fmt}, {remaining} left{postfix}"
# of a terminal that does not tell its size, where tqdm would show nothing
WIDTH, ROWS = 100, 20


def follow(training: Training, stream: TextIO | None = None) -> "Bar | Lines":
    """What to enter while a training runs and to call after each of its steps, with the step and
    its row of the log. stream: sys.stderr if not given.
    """
    stream = stream or sys.stderr
    return Bar(training, stream) if stream.isatty() else Lines(training, stream)


class Bar:
    """One line with rate, time left, PSNR, points and device memory, for a terminal. It begins once
    kernels are built, whose time says nothing of the steps to come.
    """

    def __init__(self, training: Training, stream: TextIO) -> None:
        self._dev, self._stream, self._test = training.trainer.dev, stream, ""
        self._first, self._steps = training.trainer.step, training.config.train.iterations
        self._bar = None

    def __enter__(self) -> "Bar":
        self._write(TOLD)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is None:
            self._write("")
        else:
            self._bar.close()

    def _write(self, text):
        """Put a text in place of TOLD."""
        self._stream.write(f"\r{text:{len(TOLD)}s}\r")
        self._stream.flush()

    def _opened(self, step):
        self._write("")
        return tqdm(
            total=self._steps,
            initial=step,
            unit="step",
            mininterval=REDRAWN,
            bar_format=FORMAT,
            ncols=_columns(self._stream),
            nrows=ROWS,
            file=self._stream,
        )

    def __call__(self, step: int, row: dict[str, Any] | None) -> None:
        """Move on to a step."""
        if step < self._first + BUILDING:
            return
        if self._bar is None:
            self._bar = self._opened(step)
        else:
            self._bar.update()
        if row is None:
            return
        if "test_psnr" in row:
            self._test = f" (test {row['test_psnr']:.1f})"
        self._bar.set_postfix_str(
            f"PSNR {row['psnr']:.1f}{self._test}, {row['points']} points,"
            f" {self._dev.bytes / GIB:.2f} GiB",
            refresh=False,
        )


def _columns(stream):
    """Columns of the terminal."""
    try:
        return os.get_terminal_size(stream.fileno()).columns or WIDTH
    except (OSError, ValueError):
        return WIDTH


class Lines:
    """Plain lines, of rows of the log that are LINES_APART seconds apart: for files and pipes."""

    def __init__(self, training: Training, stream: TextIO) -> None:
        self._dev, self._stream = training.trainer.dev, stream
        self._first, self._steps = training.trainer.step, training.config.train.iterations
        self._start, self._next = 0.0, 0.0

    def __enter__(self) -> "Lines":
        self._print(TOLD)
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __call__(self, step: int, row: dict[str, Any] | None) -> None:
        """Print a line, where the step has a row and the last line is long enough ago."""
        now, done = time.monotonic(), step - self._first - BUILDING
        if done <= 0:
            self._start = now
        elif row is not None and now >= self._next:
            self._next = now + LINES_APART
            rate = done / max(now - self._start, 1e-6)
            left = round((self._steps - step) / rate)
            test = f", test PSNR {row['test_psnr']:.2f}" if "test_psnr" in row else ""
            self._print(
                f"step {step} of {self._steps}, {rate:.3g} steps/s, {clock(left)} left,"
                f" PSNR {row['psnr']:.2f}{test}, {row['points']} points,"
                f" {self._dev.bytes / GIB:.2f} GiB"
            )

    def _print(self, line):
        with suppress(OSError):  # of a full disk, which is no reason to stop
            print(line, file=self._stream, flush=True)


@contextmanager
def counted(noun: str, stream: TextIO | None = None) -> Iterator[Callable[[int, int], None]]:
    """What to call with the number of things done, and of all, whenever one more is done. stream:
    sys.stderr if not given.
    """
    stream = stream or sys.stderr
    start = told = time.monotonic()
    with tqdm(
        unit=noun, leave=False, mininterval=REDRAWN, file=stream, disable=not stream.isatty()
    ) as bar:

        def tell(done: int, total: int) -> None:
            nonlocal told
            if done == 1:
                bar.reset(total)
            bar.update()
            now = time.monotonic()
            if not bar.disable or now - told < LINES_APART:
                return
            told, left = now, round((now - start) / done * (total - done))
            with suppress(OSError):  # as of Lines
                print(f"{done} of {total} {noun}s, {clock(left)} left", file=stream, flush=True)

        yield tell


def clock(seconds: int) -> str:
    """h:mm:ss, or m:ss below an hour."""
    minutes, rest = divmod(seconds, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
