"""Writes files under a temporary name, syncs and renames them. Folders that pp-cl fills list the
files that it wrote there, and it replaces and removes no others.
"""

import errno
import functools
import glob
import hashlib
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, BinaryIO

from platformdirs import user_cache_dir

from pp_cl.errors import UserError, shown

READER_SECONDS = 5  # a viewer may take so long to read a large checkpoint
DISK = (errno.EIO, errno.ENOSPC, errno.EDQUOT)  # errors of a disk, not of missing features
# the name of an unfinished file or folder, with the number of the process that writes it
TEMPORARY = re.compile(r"\..+\.(\d+)\.pp-cl\.tmp(\..*)?", re.DOTALL)
# The manifest of a folder that pp-cl fills: a line of JSON [path in the folder, SHA-256] for each
# file that it has written there or below, also for former files. The line is written before the
# rename. If the process dies in between, it matches no file, so no other file is taken for ours.
MANIFEST = ".pp-cl-files.jsonl"


@contextmanager
def atomic_file(path: Path | str, *, noted: bool = True) -> Iterator[BinaryIO]:
    """A binary file object whose content appears under `path` only when the block ends without an
    error; noted: add it to the folder's manifest. Raises UserError naming a file that cannot be
    written.
    """
    with _renamed(Path(path), noted=noted) as temporary, open(temporary, "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """As atomic_file(), but a temporary path with the same suffix, to which a library writes."""
    kinds = OSError, RuntimeError  # C++ libraries raise the latter
    with _renamed(path, path.suffix) as temporary, told(path, kinds):
        yield temporary


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that appears as `folder` only when the block ends without an error. Raises
    UserError if `folder` is not empty or cannot be written; errors in the block name final paths.
    """
    folder = folder.resolve()
    check_new_folder(folder)
    with _renamed(folder) as temporary:
        try:
            temporary.mkdir(parents=True)
            yield temporary
            if folder.is_dir():
                folder.rmdir()  # it is empty; Windows cannot replace a folder
        except UserError as error:
            raise UserError(str(error).replace(str(temporary), str(folder))) from error


@contextmanager
def _renamed(path, suffix="", *, noted=True):
    """A temporary path; what the block writes there is renamed to `path` unless it raises."""
    temporary = _temporary(path, suffix)
    try:
        with told(path):
            yield temporary
            if noted:
                _note(temporary, path)
            _replace(temporary, path)
            _sync_folder(path.parent)
    finally:
        _remove(temporary)


def _temporary(path, suffix=""):
    """The name of a file while it is written."""
    return path.parent / f".{path.name}.{os.getpid()}.pp-cl.tmp{suffix}"  # `.` and `/` have no name


def _replace(temporary, path):
    """os.replace(), which Windows refuses as long as another process reads the old file."""
    end = time.monotonic() + (READER_SECONDS if sys.platform == "win32" else 0)
    while True:
        try:
            return os.replace(temporary, path)
        except PermissionError:
            if time.monotonic() >= end:
                raise
            time.sleep(0.1)


def _sync_folder(folder):
    """Make a rename in the folder survive a power cut, if system and file system can."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    try:
        descriptor = os.open(folder, os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno in DISK:
            raise


def _remove(temporary):
    """Remove a file or folder that was not renamed; the next start removes any that remains."""
    with suppress(OSError):
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def mend(error: Exception) -> str:
    """Advice on a file that cannot be opened or written."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "free some space"
    if number in (errno.EMFILE, errno.ENFILE):
        return "allow more open files (ulimit -n)"
    if number == errno.ENAMETOOLONG:
        return "choose a shorter name"
    return "check the folder, its permissions and the disk"


@contextmanager
def told(
    path: Path | str, kinds: tuple[type[Exception], ...] = (OSError,), then: str = ""
) -> Iterator[None]:
    """Turn an exception of these kinds into a UserError with the file, advice, and `then`."""
    try:
        yield
    except kinds as error:
        reason = getattr(error, "strerror", None) or shown(str(error), 120)
        raise UserError(f"{path}: cannot be written ({reason}); {mend(error)}{then}") from error


def write_text(path: Path | str, text: str) -> None:
    """Write a text file atomically; names that are not UTF-8 are escaped."""
    with atomic_file(path) as file:
        file.write(text.encode(errors="backslashreplace"))


def write_json(path: Path | str, value: Any) -> None:
    """Write JSON atomically. Raises ValueError for NaN and Inf."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


# ---- before anything is computed


def check_new_folder(folder: Path) -> None:
    """Raise UserError if atomic_folder() would overwrite something or could not write."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UserError(f"{folder}: exists already; choose a new or empty folder")
    if folder.is_dir() and (os.path.ismount(folder) or folder.samefile(".")):
        raise UserError(f"{folder}: cannot be replaced as a whole; name a new folder in it")
    check_target(folder)


def check_file(path: Path) -> None:
    """Raise UserError if atomic_file() or atomic_path() could not write a file."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file")
    check_target(path)


def check_target(path: Path) -> None:
    """Raise UserError if nothing can be created at a path, which is tried with a temporary file in
    the nearest existing folder above it.
    """
    tried = Path(os.path.abspath(path))
    try:
        with told(path):
            while not tried.parent.exists():
                tried = tried.parent
            _temporary(tried).touch()
    finally:
        _remove(_temporary(tried))


def check_room(path: Path, needed: int) -> None:
    """Raise UserError if the disk of a file, whose folder must exist, has less than `needed` bytes
    free.
    """
    if (free := shutil.disk_usage(path.parent).free) < needed:
        raise UserError(
            f"{path}: takes {needed / 1e6:.0f} MB, and {free / 1e6:.0f} are free on its disk; free"
            " some space"
        )


# ---- the program's own files


def own(
    folder: Path, files: Iterable[Path] = (), mend: str = "move it away", *, alone: bool = False
) -> None:
    """Make a folder one that pp-cl fills, and remove the unfinished files of killed processes.
    files: files to be written there. alone: the folder must not hold files of others. Raises
    UserError, with nothing changed, if it does, and as check_ours() does for `files`.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is not a folder; choose another --out")
    check_target(folder / MANIFEST)
    if alone and folder.exists() and not is_owned(folder) and any(folder.iterdir()):
        raise UserError(f"{folder}: holds other files; choose a new or empty folder for --out")
    check_ours(files, mend)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MANIFEST).touch()
    remove_leftovers(folder)


def is_owned(folder: Path) -> bool:
    """Whether pp-cl fills a folder, so that it has a manifest."""
    return (folder / MANIFEST).is_file()


def ours(paths: Iterable[Path]) -> list[Path]:
    """The files among the paths that are still as pp-cl wrote them."""
    lines = functools.cache(lambda home: {*(home / MANIFEST).read_bytes().splitlines()})
    return [
        path
        for path in paths
        if path.is_file() and not path.is_symlink() and (home := _home(path))
        if _line(home, path, path) in lines(home)
    ]


def check_ours(paths: Iterable[Path], mend: str = "move it away") -> None:
    """Raise UserError naming the first existing file that is not ours() and would be lost."""
    there = [path for path in paths if os.path.lexists(path)]
    if others := set(there) - set(ours(there)):
        first = min(others)
        raise UserError(f"{first}: pp-cl did not write this, or it was changed since; {mend}")


def remove_ours(paths: Iterable[Path]) -> None:
    """Remove the files that are ours(), and then their empty folders."""
    for path in ours(paths):
        path.unlink()
        for folder in path.parents:
            if any(folder.iterdir()):  # at the latest the folder with the manifest
                break
            folder.rmdir()


def _home(path):
    """The nearest folder above that pp-cl fills; None without one, and in unfinished folders."""
    for folder in Path(os.path.abspath(path)).parents:
        if is_owned(folder):
            return folder
        if TEMPORARY.fullmatch(folder.name):
            return None
    return None


def _note(file, path):
    """Add a file, or all files in a folder, soon renamed to `path`, to the nearest manifest."""
    if home := _home(path):
        inside = sorted(file.rglob("*")) if file.is_dir() else [file]
        lines = [
            _line(home, path / part.relative_to(file), part) for part in inside if part.is_file()
        ]
        with open(home / MANIFEST, "ab") as manifest:
            # each line begins with a newline, since a killed process may have cut the last line
            manifest.write(b"".join(b"\n" + line for line in lines))
            manifest.flush()
            os.fsync(manifest.fileno())


def _line(home, path, file):
    """The manifest's line for the content of `file`, which is, or will be, called `path`."""
    relative = Path(os.path.abspath(path)).relative_to(home)
    return json.dumps([relative.as_posix(), sha256_of(file).hexdigest()]).encode()


def sha256_of(file: Path) -> Any:
    """The hashlib digest of a file, which is read in pieces."""
    digest = hashlib.sha256()
    with open(file, "rb") as opened:
        while part := opened.read(2**20):
            digest.update(part)
    return digest


def remove_leftovers(folder: Path | str) -> None:
    """Delete temporary files and folders that killed processes left in the folder and below it, and
    the files beside it with which check_target() tried whether it can be made.
    """
    place = Path(os.path.abspath(folder))
    tried = place.parent.glob(f".{glob.escape(place.name)}.[0-9]*.pp-cl.tmp")
    for leftover in [*place.rglob(".*.pp-cl.tmp*"), *filter(Path.is_file, tried)]:
        named = TEMPORARY.fullmatch(leftover.name)
        if not named or _lives(int(named[1])):
            continue
        # Windows cannot tell which process is alive, but refuses to delete a file that one has open
        with suppress(PermissionError) if sys.platform == "win32" else nullcontext():
            if leftover.is_dir() and not leftover.is_symlink():
                shutil.rmtree(leftover)
            else:
                leftover.unlink(missing_ok=True)


def _lives(process):
    """Whether another process has this number; False if the system cannot tell."""
    if os.name != "posix" or process == os.getpid():
        return False
    try:
        os.kill(process, 0)  # sends no signal
    except PermissionError:
        return True
    except (ProcessLookupError, OverflowError):
        return False
    return True


# ---- the user's cache


def cache_folder() -> Path:
    """PP_CACHE, or else the user's cache folder on this system."""
    return Path(os.environ.get("PP_CACHE") or user_cache_dir("pp-cl"))


def make_cache_folder() -> Path:
    """cache_folder(), created if it is missing. Raises UserError if that fails."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be created ({error.strerror}); set PP_CACHE to a writable folder"
        ) from None
    return folder
