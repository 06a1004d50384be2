"""How a sweep shows that it goes on: a line for each run that ends, and on a terminal below them a
block with those that are at work.
"""

import shutil
import time
from collections.abc import Sequence
from typing import Any, TextIO

from pp_cl.sweep.plan import Job
from pp_cl.sweep.result import progress
from pp_cl.sweep.table import run_text, values_text

REDRAWN = 1.0  # seconds, at least, between two states of the block
UP_AND_CLEAR = "\x1b[{}F\x1b[J"


class LiveTable:
    """The runs of a sweep that are still to do, on a stream."""

    def __init__(self, stream: TextIO, jobs: Sequence[Job], done: int) -> None:
        self._stream, self._moves = stream, stream.isatty()
        self._jobs = {job.folder: job for job in jobs}
        self._all, self._done, self._failed = done + len(jobs), done, 0
        self._before = {job.folder: _size(job) for job in jobs}
        self._block, self._next = 0, 0.0

    def end(self, row: dict[str, Any]) -> None:
        """A run has ended with this row."""
        del self._jobs[row["folder"]]
        self._done += 1
        self._failed += "error" in row
        self._clear()
        self._next = 0.0  # the block is gone
        self._write(f"[{self._done} of {self._all}] {run_text(row)}: {values_text(row)}")

    def tick(self) -> None:
        """Redraw the block, where the stream is a terminal and the last one is old enough."""
        now = time.monotonic()
        if not self._moves or now < self._next:
            return
        self._next = now + REDRAWN
        lines = [f"  {job}: {progress(job)}" for job in self.at_work()]
        failed = f", {self._failed} failed" if self._failed else ""
        lines.append(f"{self._done} of {self._all} runs done{failed}, {len(lines)} at work")
        size = shutil.get_terminal_size()
        shown = lines[-(size.lines - 1) :]
        self._clear()
        self._write("\n".join(line[: size.columns - 1] for line in shown))
        self._block = len(shown)

    def at_work(self) -> list[Job]:
        """The runs that a process has worked on since the beginning and that have not ended."""
        return [job for job in self._jobs.values() if _size(job) != self._before[job.folder]]

    def _clear(self):
        if self._block:
            self._stream.write(UP_AND_CLEAR.format(self._block))
        self._block = 0

    def _write(self, text):
        self._stream.write(text + "\n")
        self._stream.flush()


def _size(job):
    """Bytes of the job's log, which each process begins with a line."""
    return job.log.stat().st_size if job.log.exists() else 0
