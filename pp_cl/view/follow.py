"""The rows of a log while it is written."""

import json
import math
import os
from pathlib import Path

MOST_LINE = 2**16  # bytes; a longer line is none of ours


class LogFollower:
    """Reads what a log.jsonl has gained, line by line; a last line without its end waits for it.

    rows: [[step, loss, psnr]] so far. starts: how often the log began anew, which it does when a
    training resumes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[list[float]] = []
        self.starts = 0
        self._read = 0  # bytes
        self._inode = None

    def poll(self) -> bool:
        """Read on; whether rows came or went. A log that is missing has no rows yet."""
        before = len(self.rows), self.starts
        try:
            with open(self.path, "rb") as file:
                self._begin_anew_if_replaced(os.fstat(file.fileno()))
                file.seek(self._read)
                text = file.read()
        except OSError:
            return False
        whole = text[: text.rfind(b"\n") + 1]
        self._read += len(whole)
        found = (_read_row(line) for line in whole.splitlines())
        self.rows += [row for row in found if row]
        return before != (len(self.rows), self.starts)

    def _begin_anew_if_replaced(self, found):
        if self._inode not in (None, found.st_ino) or found.st_size < self._read:
            self.rows, self._read = [], 0
            self.starts += 1
        self._inode = found.st_ino


def _read_row(line):
    """[step, loss, psnr] of a line that has them as finite numbers, else None."""
    try:
        row = json.loads(line) if len(line) <= MOST_LINE else None
        values = [row[name] for name in ("step", "loss", "psnr")]
    except (ValueError, RecursionError, TypeError, KeyError):
        return None
    kept = all(type(value) in (int, float) and math.isfinite(value) for value in values)
    return values if kept else None
