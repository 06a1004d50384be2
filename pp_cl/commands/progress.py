"""How a training shows that it goes on: one line on a terminal, elsewhere now and then a line."""

import sys
import time
from typing import Any, TextIO

from tqdm import tqdm

from pp_cl.run import Training

REDRAWN = 1  # seconds, at least, between two states of the bar
LINES_APART = 30  # seconds, at least, between the lines in a file
GIB = 2**30


def follow(training: Training, stream: TextIO | None = None) -> "Bar | Lines":
    """What to enter while a training runs and to call after each of its steps, with the step and
    its row of the log. stream: sys.stderr if not given.
    """
    stream = stream or sys.stderr
    return Bar(training, stream) if stream.isatty() else Lines(training, stream)


class Bar:
    """One line with rate, time left, PSNR, points and device memory, for a terminal."""

    def __init__(self, training: Training, stream: TextIO) -> None:
        self._dev, self._test = training.trainer.dev, {}
        self._bar = tqdm(
            total=training.config.train.iterations,
            initial=training.trainer.step,
            unit="step",
            delay=1e-6,  # shows from the first step on, not above an error before it
            mininterval=REDRAWN,
            dynamic_ncols=True,
            file=stream,
        )

    def __enter__(self) -> "Bar":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, step: int, row: dict[str, Any] | None) -> None:
        """Move on to a step."""
        self._bar.update()
        if row is None:
            return
        if "test_psnr" in row:
            self._test = {"test": f"{row['test_psnr']:.2f}"}
        self._bar.set_postfix(
            psnr=f"{row['psnr']:.2f}",
            **self._test,
            points=row["points"],
            memory=f"{self._dev.bytes / GIB:.2f}GiB",
            refresh=False,
        )


class Lines:
    """Plain lines, of rows of the log that are LINES_APART seconds apart: for files and pipes."""

    def __init__(self, training: Training, stream: TextIO) -> None:
        self._dev, self._stream = training.trainer.dev, stream
        self._first, self._steps = training.trainer.step, training.config.train.iterations
        self._start, self._next = time.monotonic(), 0.0

    def __enter__(self) -> "Lines":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __call__(self, step: int, row: dict[str, Any] | None) -> None:
        """Print a line, where the step has a row and the last line is long enough ago."""
        now = time.monotonic()
        if row is None or now < self._next:
            return
        self._next = now + LINES_APART
        rate = (step - self._first) / max(now - self._start, 1e-6)
        left = round((self._steps - step) / rate)
        test = f", test PSNR {row['test_psnr']:.2f}" if "test_psnr" in row else ""
        print(
            f"step {step} of {self._steps}, {rate:.3g} steps/s, {clock(left)} left,"
            f" PSNR {row['psnr']:.2f}{test}, {row['points']} points,"
            f" {self._dev.bytes / GIB:.2f} GiB",
            file=self._stream,
            flush=True,
        )


def clock(seconds: int) -> str:
    """h:mm:ss, or m:ss below an hour."""
    minutes, rest = divmod(seconds, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
