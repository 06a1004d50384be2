"""Atomic writes: to a temporary name, synced, then renamed; and the user's cache folder."""

import errno
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, BinaryIO

from platformdirs import user_cache_dir

from pp_cl.errors import UserError
from pp_cl.files.manifest import TEMPORARY, note

READER_SECONDS = 5  # which a viewer takes to read a large checkpoint
# what file systems say that cannot sync a folder, and folders that may be written, not read
UNKNOWN_TO_FOLDERS = (
    errno.EINVAL,
    errno.ENOTSUP,
    errno.EOPNOTSUPP,
    errno.ENOSYS,
    errno.EBADF,
    errno.EACCES,
    errno.EPERM,
)


@contextmanager
def atomic_file(path: Path | str, *, noted: bool = True) -> Iterator[BinaryIO]:
    """A binary file object whose content appears under `path` only when the block ends well.

    noted: in the manifest of the folder that the program fills, if it is one. Raises UserError
    naming the file when the disk is full or may not be written; nothing half-written stays behind.
    """
    path = Path(path)
    with _named(_temporary(path), path, noted) as temporary, open(temporary, "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path of the same suffix for a library to write to, whose file appears under
    `path` only when the block ends well.

    Raises UserError naming the file when the library cannot write it.
    """
    with _named(_temporary(path, path.suffix), path) as temporary:
        try:
            yield temporary
        except RuntimeError as error:  # of libraries in C++
            raise _refusal(path, error) from error


@contextmanager
def _named(temporary, path, noted=True):
    """The temporary path; what is written there gets its name when the block ends well."""
    try:
        yield temporary
        if noted:
            note(temporary, path)
        _replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise _refusal(path, error) from error
    finally:
        _remove(temporary)


def _replace(temporary, path):
    """os.replace(), which Windows refuses as long as another process reads what is there."""
    end = time.monotonic() + (READER_SECONDS if sys.platform == "win32" else 0)
    while True:
        try:
            return os.replace(temporary, path)
        except PermissionError:
            if time.monotonic() >= end:
                raise
            time.sleep(0.1)


def _temporary(path, suffix=""):
    """The name under which a file is written."""
    return path.parent / f".{path.name}.{os.getpid()}.pp-cl.tmp{suffix}"  # `.` and `/` have no name


def mend(error: OSError) -> str:
    """What to do about a file that cannot be opened or written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "free some space"
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return "allow more open files (ulimit -n)"
    if error.errno == errno.ENAMETOOLONG:
        return "choose a shorter name"
    return "check the folder, its permissions and the disk"


def _refusal(path, error):
    """The UserError of a path that cannot be written. error: an OSError, or one of a library."""
    if isinstance(error, OSError) and error.errno:
        return UserError(f"{path}: cannot be written ({error.strerror}); {mend(error)}")
    reason = " ".join(str(error).split())[:120]
    return UserError(
        f"{path}: cannot be written ({reason}); check the folder, its permissions and free space"
    )


def _remove(temporary):
    """Remove what did not get its final name; what stays is removed by the next start."""
    with suppress(OSError):
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that appears as `folder` only when the block ends well.

    Raises UserError if that holds something, or cannot be written; one of a file in the temporary
    folder names the place that it would have had.
    """
    folder = folder.resolve()
    check_new_folder(folder)
    unfinished = _temporary(folder)
    try:
        unfinished.mkdir(parents=True)
        yield unfinished
        note(unfinished, folder)
        if folder.is_dir():
            folder.rmdir()  # it is empty; Windows replaces no folder
        _replace(unfinished, folder)
    except OSError as error:
        raise _refusal(folder, error) from error
    except UserError as error:
        raise UserError(str(error).replace(str(unfinished), str(folder))) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def check_new_folder(folder: Path) -> None:
    """Raise UserError where atomic_folder would write over something, or could not."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UserError(f"{folder}: exists already; choose a new or empty folder")
    if folder.is_dir() and (os.path.ismount(folder) or folder.samefile(".")):
        raise UserError(f"{folder}: cannot be replaced as a whole; name a new folder in it")
    check_target(folder)


def check_file(path: Path) -> None:
    """Raise UserError where atomic_file or atomic_path could not write a file."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file")
    check_target(path)


def check_target(path: Path) -> None:
    """Raise UserError where nothing can be made under a path, or no folder above it: tried with a
    temporary file in the first folder above that there is.
    """
    tried = Path(os.path.abspath(path))
    try:
        while not tried.parent.exists():
            tried = tried.parent
        _temporary(tried).touch()
    except OSError as error:
        raise _refusal(path, error) from None
    finally:
        _remove(_temporary(tried))


def _sync_folder(folder):
    """Make a rename in the folder survive a power cut, where system and file system know how."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    try:
        descriptor = os.open(folder, os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in UNKNOWN_TO_FOLDERS:
            raise


def write_text(path: Path | str, text: str) -> None:
    """Write a text file atomically; names that are no UTF-8 are escaped."""
    with atomic_file(path) as file:
        file.write(text.encode(errors="backslashreplace"))


def write_json(path: Path | str, value: Any) -> None:
    """Write JSON atomically; NaN and Inf are refused with ValueError."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def remove_leftovers(folder: Path | str) -> None:
    """Delete temporary files and folders that killed processes left in the folder and below it, not
    those of processes that live.
    """
    for leftover in list(Path(folder).rglob(".*.pp-cl.tmp*")):
        named = TEMPORARY.fullmatch(leftover.name)
        if not named or _lives(int(named[1])):
            continue
        # Windows cannot tell who lives, but refuses what a process has open
        with suppress(PermissionError) if sys.platform == "win32" else nullcontext():
            if leftover.is_dir() and not leftover.is_symlink():
                shutil.rmtree(leftover)
            else:
                leftover.unlink(missing_ok=True)


def _lives(process):
    """Whether another process has this number; where the system has no way to ask, none has."""
    if os.name != "posix" or process == os.getpid():
        return False
    try:
        os.kill(process, 0)  # sends nothing
    except PermissionError:
        return True
    except (ProcessLookupError, OverflowError):
        return False
    return True


def cache_folder() -> Path:
    """PP_CACHE, else the user's cache folder of the system."""
    return Path(os.environ.get("PP_CACHE") or user_cache_dir("pp-cl"))


def make_cache_folder() -> Path:
    """The same, made where it is missing. Raises UserError if that fails."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be made ({error.strerror}); "
            "set PP_CACHE to a folder that can be written"
        ) from None
    return folder
