"""Shows the progress of a long stage: with a bar on a terminal, elsewhere with a line now and then.

A thread updates it, also while the stage is in one long call of a library or a driver.
"""

import shutil
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any, TextIO, TypeVar

from tqdm import tqdm

REDRAWN = 1.0  # seconds between two updates of the bar
LINES_APART = 25.0  # seconds between two lines of all stages, and some more between stages
# tqdm's format, but shorter, so that the note has room; a terminal cuts it off at the right border
FORMAT = (
    "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}, {rate_fmt}, {remaining} left{postfix}"
)
ENDLESS = "{desc}: {elapsed}{postfix}"  # if the total is unknown
TIMED = "{desc}: {percentage:3.0f}%|{bar}| $left{postfix}"  # if the stage has a time, and no units
# of a terminal that does not tell its size, on which tqdm would show nothing
SIZE = 100, 20

Item = TypeVar("Item")
_told = time.monotonic()  # when the last line was due
_shown: "Progress | None" = None  # the stage that is shown; stages within it are not


class Progress:
    """Shows the progress of a stage while its block runs. what: the stage's name, such as
    `matching`; total: its number of units, or None if unknown; done: units done before; stream:
    None for sys.stderr. given: minutes that the stage has; its units are then seconds, which pass
    by themselves. The text of `note` is shown after the numbers. Nothing is shown within another
    stage.
    """

    def __init__(
        self,
        what: str,
        total: int | None = None,
        unit: str = "",
        *,
        done: int = 0,
        given: float = 0.0,
        stream: TextIO | None = None,
    ) -> None:
        self.total, self.note = round(60 * given) or total, ""
        self._given = given
        self._what, self._unit, self._stream = what, unit, stream or sys.stderr
        self._first = self._done = done
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def __enter__(self) -> "Progress":
        global _shown
        self._start, self._bar = time.monotonic(), None
        if _shown is not None:
            return self
        _shown = self
        if self._stream.isatty():
            columns, rows = shutil.get_terminal_size(SIZE)
            self._bar = tqdm(
                desc=self._what,
                total=self.total,
                initial=self._first,
                unit=self._unit or "it",
                leave=False,
                bar_format=FORMAT if self.total else ENDLESS,
                ncols=columns,
                nrows=rows,
                file=self._stream,
            )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        global _shown
        if _shown is not self:
            return
        _shown = None
        self._ended.set()
        self._thread.join()
        if self._bar is not None:
            self._bar.close()

    def update(self, done: int = 1) -> None:
        """Add the units that were done since the last call."""
        self._done += done

    def _follow(self):
        while not self._ended.wait(min(REDRAWN, LINES_APART)):
            with suppress(OSError, ValueError):  # the disk may be full, or the stream closed
                self._show()

    def _show(self):
        global _told
        now = time.monotonic()
        if self._given:
            self._done = min(self._first + int(now - self._start), round(60 * self._given))
        if self._bar is not None:
            if self._given:
                self._bar.bar_format = TIMED.replace("$left", self._left())
            self._bar.n, self._bar.total = self._done, self.total
            self._bar.set_postfix_str(self.note)
        elif now - _told >= LINES_APART:
            _told = now
            print(self._line(now - self._start), file=self._stream, flush=True)

    def _line(self, seconds):
        """The line for a stream that is no terminal, after `seconds` of the stage."""
        if self._given:
            return f"{self._what}: {', '.join([self._left()] + [self.note] * bool(self.note))}"
        done = self._done - self._first
        parts = [f"{self._done} of {self.total} {self._unit}s"] if self.total else []
        if self.total and done:
            remaining = tqdm.format_interval((self.total - self._done) * seconds / done)
            parts += [f"{done / seconds:.3g} a second", f"{remaining} left"]
        else:
            parts.append(f"{tqdm.format_interval(seconds)} so far")
        return f"{self._what}: {', '.join(parts + [self.note] * bool(self.note))}"

    def _left(self):
        minutes_left = max(self._given - self._done / 60, 0.0)
        return f"{minutes_left:.1f} of {self._given:.1f} minutes left"


def track(
    items: Iterable[Item], what: str, unit: str, total: int | None = None, **options: Any
) -> Iterator[Item]:
    """Yield the items with a Progress. total: their number, if they are not a sequence."""
    if total is None and isinstance(items, Sequence):
        total = len(items)
    with Progress(what, total, unit, **options) as progress:
        for item in items:
            yield item
            progress.update()
