"""The folder of a run: the names in it, its checkpoint, its log."""

import json
import math
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from pp_cl.errors import UserError
from pp_cl.files.atomic import remove_leftovers, write_text
from pp_cl.files.checkpoint import Rows, checkpoint_shapes, load_checkpoint, save_checkpoint

# what the header of a run's checkpoint holds at least
HEADER = ("scene", "step", "finished", "initial_points", "grid", "depth_range")


class RunFolder:
    """path: the folder; config, checkpoint, log, previews: paths in it, which need not exist."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.config = self.path / "config.json"
        self.checkpoint = self.path / "checkpoint.npz"
        self.log = self.path / "log.jsonl"
        self.previews = self.path / "previews"

    def __str__(self) -> str:
        return str(self.path)

    def evaluation(self, split: str) -> Path:
        """Folder of the evaluation of a split: eval for test, eval/SPLIT for others."""
        return self.path / "eval" if split == "test" else self.path / "eval" / split

    def check_usable(self) -> None:
        """Raise UserError if the folder is a file, or holds files that belong to no run."""
        if self.path.exists() and not self.path.is_dir():
            raise UserError(f"{self}: is not a folder; choose another --out")
        if self.config.exists() or not self.path.exists():
            return
        if any(not p.name.startswith(".") for p in self.path.iterdir()):
            raise UserError(
                f"{self}: holds other files and no config.json; choose an empty or new folder for"
                " --out"
            )

    @contextmanager
    def owned(self) -> Iterator[None]:
        """While the block runs, no other process trains into the folder, which is made where it is
        missing. The system ends the ownership of a process that was killed.

        Raises UserError naming the process that owns the folder.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        owner, lock = self.path / ".owner", FileLock(self.path / ".lock", timeout=0)
        try:
            lock.acquire()
        except Timeout:
            try:
                who = owner.read_text().strip()
            except OSError:
                who = "another process"
            raise UserError(
                f"{self}: {who} trains into it; wait for its end, or choose another --out"
            ) from None
        try:
            owner.write_text(f"process {os.getpid()} on {socket.gethostname()}\n")
            yield
        finally:
            owner.unlink(missing_ok=True)
            lock.release()

    def create(self, config_json: str) -> None:
        """Make the folders, remove what a killed process left unfinished, write config.json."""
        self.previews.mkdir(parents=True, exist_ok=True)
        for folder in (self.path, self.previews):
            remove_leftovers(folder)
        write_text(self.config, config_json + "\n")

    def load(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """(header, arrays) of the checkpoint. Raises UserError as load_checkpoint does, and for an
        incomplete header.
        """
        header, arrays = load_checkpoint(self.checkpoint)
        self._check_header(header)
        return header, arrays

    def shapes(self) -> tuple[dict[str, Any], dict[str, tuple[int, ...]]]:
        """(header, {name: shape}) of the checkpoint, whose arrays are not read. Raises UserError as
        load() does.
        """
        header, shapes = checkpoint_shapes(self.checkpoint)
        self._check_header(header)
        return header, shapes

    def _check_header(self, header):
        missing = [key for key in HEADER if key not in header]
        if missing:
            raise UserError(
                f"{self.checkpoint}: its header lacks {', '.join(missing)}; delete it to train"
                " anew, or restore a copy"
            )

    def rows(self) -> list[dict[str, Any]]:
        """The rows of the log, up to the first that is broken."""
        return _rows(self.log)

    def save(self, header: dict[str, Any], arrays: Mapping[str, np.ndarray | Rows]) -> None:
        """Replace the checkpoint."""
        save_checkpoint(self.checkpoint, header, arrays)

    def open_log(self, step: int) -> "Log":
        """The log, cut off after `step`: later rows will be made again."""
        return Log(self.log, step)


class Log:
    """A file of one JSON object per logged step. seconds: of training, up to its last row."""

    def __init__(self, path: Path, step: int) -> None:
        rows = _rows_until(path, step)
        write_text(path, "".join(json.dumps(row) + "\n" for row in rows))
        self.seconds = rows[-1]["seconds"] if rows else 0.0
        # unbuffered: a failed write leaves nothing that closing would try to write again
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115

    def __enter__(self) -> "Log":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, row: dict[str, Any]) -> None:
        """Append a row. Raises UserError naming the file when it cannot be written, ValueError for
        NaN.
        """
        data = (json.dumps(row, allow_nan=False) + "\n").encode()
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            raise UserError(
                f"{self._file.name}: cannot be written ({error.strerror}); free some space, the"
                " same command goes on"
            ) from error


def _rows(path):
    """The rows of a log up to the first that is broken."""
    lines = path.read_text("utf-8", "replace").splitlines() if path.exists() else ()
    return list(takewhile(lambda row: row is not None, map(_read_row, lines)))


def _rows_until(path, step):
    """The rows of a log up to `step`, or up to the first that is broken or says finished."""
    return list(takewhile(lambda row: row["step"] <= step and not row.get("finished"), _rows(path)))


def _read_row(line):
    """The object of a line; None where a kill or a fault left no row with step and seconds."""
    try:
        row = json.loads(line)
        json.dumps(row, allow_nan=False)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict) or type(row.get("step")) is not int:
        return None
    seconds = row.get("seconds")
    return row if type(seconds) in (int, float) and math.isfinite(seconds) else None
