"""Files written to a temporary name, synced, renamed: all of one or nothing."""

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from pp_cl.errors import UserError


@contextmanager
def atomic_file(path: Path | str) -> Iterator[BinaryIO]:
    """A binary file object whose content appears under `path` only when the block ends well.

    Raises UserError naming the file when the disk is full or may not be written; nothing
    half-written stays behind.
    """
    path = Path(path)
    temporary = path.parent / f".{path.name}.{os.getpid()}.tmp"  # `.` and `/` have no name
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        mend = (
            "free some space"
            if error.errno in (errno.ENOSPC, errno.EDQUOT)
            else "check the folder and its permissions"
        )
        raise UserError(f"{path}: cannot be written ({error.strerror}); {mend}") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path of the same suffix for a library to write to, whose file appears under
    `path` only when the block ends well.

    Raises UserError naming the file when the library cannot write it.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # libraries in C++ raise the latter
        reason = " ".join(str(error).split())[:120]
        raise UserError(
            f"{path}: cannot be written ({reason}); check the folder, its permissions and free"
            " space"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that appears as `folder` only when the block ends well.

    Raises UserError if that holds something, or cannot be written.
    """
    folder = folder.resolve()
    check_new_folder(folder)
    unfinished = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        unfinished.mkdir(parents=True)
        yield unfinished
        os.replace(unfinished, folder)
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be written ({error.strerror}); check permissions and free space"
        ) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def check_new_folder(folder: Path) -> None:
    """Raise UserError where atomic_folder would write over something."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UserError(f"{folder}: exists already; choose a new or empty folder")


def _sync_folder(folder):
    """Make a rename in the folder survive a power cut, where the system knows how."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path | str, text: str) -> None:
    """Write a text file atomically."""
    with atomic_file(path) as file:
        file.write(text.encode())


def write_json(path: Path | str, value: Any) -> None:
    """Write JSON atomically; NaN and Inf are refused with ValueError."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def remove_leftovers(folder: Path | str) -> None:
    """Delete temporary files that a killed process left in the folder."""
    for leftover in Path(folder).glob(".*.tmp*"):
        leftover.unlink(missing_ok=True)
