"""How a long command shows that it goes on, on a terminal and elsewhere."""

import shutil
import sys
import time
from contextlib import suppress
from typing import Any, TextIO

from tqdm import tqdm

from pp_cl.config import preset
from pp_cl.session.training import Training

BUILDING = 2  # steps in which nearly all kernels are built, if the driver has not kept them
REDRAWN = 1  # seconds, at least, between two states of the bar
LINES_APART = 30  # seconds, at least, between the lines in a file
GIB = 2**30
# tqdm's, with little beside what follows; it is cut off at the right border
FORMAT = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}, {rate_fmt}, {remaining} left{postfix}"
# of a terminal that does not tell its size, where tqdm would show nothing
SIZE = 100, 20


class Progress:
    """Rate, time left, PSNR, points and device memory of a training: to be entered while it runs,
    and called after each of its steps with the step and its row of the log. It begins once kernels
    are built, whose time says nothing of the steps to come. stream: sys.stderr if not given.
    """

    def __init__(self, training: Training, stream: TextIO | None = None) -> None:
        self._dev, self._stream = training.trainer.dev, stream or sys.stderr
        self._built = training.trainer.step + BUILDING
        self._config, self._steps = training.config, training.config.train.iterations
        self._is_told = False  # how many steps train.minutes allow
        self._bar, self._test, self._start, self._next = None, "", 0.0, 0.0

    def __enter__(self) -> "Progress":
        _print("building kernels (once)", self._stream)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, step: int, row: dict[str, Any] | None) -> None:
        """Move on to a step."""
        now = time.monotonic()
        if step == self._built:
            self._start = now
            if self._stream.isatty():
                self._bar = self._opened(step)
        elif self._bar is not None:
            self._bar.update()
        if self._config.train.iterations != self._steps:
            self._replan()
        if step <= self._built or row is None:
            return
        if "test_psnr" in row:
            self._test = f" (test {row['test_psnr']:.2f})"
        memory = self._dev.bytes / GIB
        text = f"PSNR {row['psnr']:.2f}{self._test}, {row['points']} points, {memory:.2f} GiB"
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=False)
        elif now >= self._next:
            self._next = now + LINES_APART
            rate = (step - self._built) / max(now - self._start, 1e-6)
            left = tqdm.format_interval((self._steps - step) / rate)
            line = f"step {step} of {self._steps}, {rate:.3g} steps/s, {left} left, {text}"
            _print(line, self._stream)

    def _replan(self):
        """Take up the steps that train.minutes allow; the first time, tell of them."""
        name, train = self._config.preset, self._config.train
        if not self._is_told:
            own = preset(name).train.iterations
            minutes = f"{train.minutes:g} min"
            text = f"{minutes}: {name}, about {train.iterations} steps (its own are {own})"
            tqdm.write(text, self._stream)
        self._steps, self._is_told = train.iterations, True
        if self._bar is not None:
            self._bar.total = self._steps

    def _opened(self, step):
        columns, rows = shutil.get_terminal_size(SIZE)
        return tqdm(
            total=self._steps,
            initial=step,
            unit="step",
            mininterval=REDRAWN,
            bar_format=FORMAT,
            ncols=columns,
            nrows=rows,
            file=self._stream,
        )


def _print(line, stream):
    with suppress(OSError):  # of a full disk, which is no reason to stop
        print(line, file=stream, flush=True)
