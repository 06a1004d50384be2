"""Files are written under a temporary name, synced and renamed; folders that the program fills know
which files in them are its own, and it replaces and removes no others.
"""

import errno
import functools
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

READER_SECONDS = 5  # which a viewer takes to read a large checkpoint
DISK = (errno.EIO, errno.ENOSPC, errno.EDQUOT)  # errors of a disk, not of what a system cannot do
# of what is being written, with the number of its process
TEMPORARY = re.compile(r"\..+\.(\d+)\.pp-cl\.tmp(\..*)?", re.DOTALL)
# In a folder that the program fills, its manifest: a line of JSON [path in the folder, SHA-256] for
# each file that it has written there or below, also for former ones. A line is added before the
# file gets its name; after a kill in between it says nothing of a file of others.
MANIFEST = ".pp-cl-files.jsonl"


@contextmanager
def atomic_file(path: Path | str, *, noted: bool = True) -> Iterator[BinaryIO]:
    """A binary file object whose content appears under `path` only when the block ends well; noted:
    in the manifest of the folder. Raises UserError naming a file that cannot be written.
    """
    with _renamed(Path(path), noted=noted) as temporary, open(temporary, "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """The same as a temporary path of the same suffix, for a library to write to."""
    kinds = OSError, RuntimeError  # the latter of libraries in C++
    with _renamed(path, path.suffix) as temporary, told(path, kinds):
        yield temporary


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that appears as `folder` only when the block ends well. Raises UserError
    if that holds something or cannot be written, with the final place of a file in it.
    """
    folder = folder.resolve()
    check_new_folder(folder)
    with _renamed(folder) as temporary:
        try:
            temporary.mkdir(parents=True)
            yield temporary
            if folder.is_dir():
                folder.rmdir()  # it is empty; Windows replaces no folder
        except UserError as error:
            raise UserError(str(error).replace(str(temporary), str(folder))) from error


@contextmanager
def _renamed(path, suffix="", *, noted=True):
    """A temporary path, of which what is there gets the name `path` when the block ends well."""
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
    """The name under which a file is written."""
    return path.parent / f".{path.name}.{os.getpid()}.pp-cl.tmp{suffix}"  # `.` and `/` have no name


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
        if error.errno in DISK:
            raise


def _remove(temporary):
    """Remove what did not get its final name; what stays is removed by the next start."""
    with suppress(OSError):
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def mend(error: Exception) -> str:
    """What to do about a file that cannot be opened or written."""
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
    """An exception of these kinds becomes a UserError with the file and the mend, and `then`."""
    try:
        yield
    except kinds as error:
        reason = getattr(error, "strerror", None) or shown(str(error), 120)
        raise UserError(f"{path}: cannot be written ({reason}); {mend(error)}{then}") from error


def write_text(path: Path | str, text: str) -> None:
    """Write a text file atomically; names that are no UTF-8 are escaped."""
    with atomic_file(path) as file:
        file.write(text.encode(errors="backslashreplace"))


def write_json(path: Path | str, value: Any) -> None:
    """Write JSON atomically; NaN and Inf are refused with ValueError."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


# ---- before anything is computed


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
    """Raise UserError where nothing can be made under a path: tried with a temporary file in the
    first folder above that there is.
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
    """Raise UserError where the disk of a file, whose folder is there, has no room for so many
    bytes beside what it holds.
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
    """Make a folder one that the program fills, and remove what killed processes left unfinished
    in it. files: will be written there. alone: nothing of others may be there before. Raises
    UserError, with nothing changed, as that says, and as check_ours does for `files`.
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
    """Whether the program fills a folder."""
    return (folder / MANIFEST).is_file()


def ours(paths: Iterable[Path]) -> list[Path]:
    """Those of the files that are as the program has written them."""
    lines = functools.cache(lambda home: {*(home / MANIFEST).read_bytes().splitlines()})
    return [
        path
        for path in paths
        if path.is_file() and not path.is_symlink() and (home := _home(path))
        if _line(home, path, path) in lines(home)
    ]


def check_ours(paths: Iterable[Path], mend: str = "move it away") -> None:
    """Raise UserError naming the first file that is there and not ours(): it would be lost."""
    there = [path for path in paths if os.path.lexists(path)]
    if others := set(there) - set(ours(there)):
        first = min(others)
        raise UserError(f"{first}: was not written by pp-cl, or was changed since; {mend}")


def remove_ours(paths: Iterable[Path]) -> None:
    """Remove those of the files that are ours(), and the folders that are empty without them."""
    for path in ours(paths):
        path.unlink()
        for folder in path.parents:
            if any(folder.iterdir()):  # at the latest the one with the manifest
                break
            folder.rmdir()


def _home(path):
    """The folder nearest above that the program fills; None without one, and in unfinished ones."""
    for folder in Path(os.path.abspath(path)).parents:
        if is_owned(folder):
            return folder
        if TEMPORARY.fullmatch(folder.name):
            return None
    return None


def _note(file, path):
    """Add a file, or all in a folder, that is about to become `path`, to the nearest manifest."""
    if home := _home(path):
        inside = sorted(file.rglob("*")) if file.is_dir() else [file]
        lines = [_line(home, path / one.relative_to(file), one) for one in inside if one.is_file()]
        with open(home / MANIFEST, "ab") as manifest:
            # the end of a line stands before it: the last one may be cut, of a process that was
            # killed
            manifest.write(b"".join(b"\n" + line for line in lines))
            manifest.flush()
            os.fsync(manifest.fileno())


def _line(home, path, file):
    """The line of a manifest for what stands in `file` and is, or will be, called `path`."""
    relative = Path(os.path.abspath(path)).relative_to(home)
    return json.dumps([relative.as_posix(), sha256_of(file).hexdigest()]).encode()


def sha256_of(file: Path) -> Any:
    """The digest object of a file, which is read in pieces."""
    digest = hashlib.sha256()
    with open(file, "rb") as opened:
        while part := opened.read(2**20):
            digest.update(part)
    return digest


def remove_leftovers(folder: Path | str) -> None:
    """Delete temporary files and folders that killed processes left in the folder and below it."""
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


# ---- the user's cache


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
