"""The rows of a log while it is written."""

import os
from pathlib import Path

from pp_cl.files.run_folder import read_row
from pp_cl.files.untrusted import opened_regular

NAMES = ("step", "loss", "psnr")


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
            with opened_regular(self.path) as file:
                self._begin_anew_if_replaced(os.fstat(file.fileno()))
                file.seek(self._read)
                text = file.read()
        except OSError:
            return False
        whole = text[: text.rfind(b"\n") + 1]
        self._read += len(whole)
        found = (_shown(line) for line in whole.splitlines())
        self.rows += [row for row in found if row]
        return before != (len(self.rows), self.starts)

    def _begin_anew_if_replaced(self, found):
        if self._inode not in (None, found.st_ino) or found.st_size < self._read:
            self.rows, self._read = [], 0
            self.starts += 1
        self._inode = found.st_ino


def _shown(line):
    """[step, loss, psnr] of a line that is a row with all three, else None."""
    row = read_row(line)
    return [row[name] for name in NAMES] if row and all(name in row for name in NAMES) else None
