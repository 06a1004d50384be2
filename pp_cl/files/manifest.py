"""What the program has written into the folders that it fills, where it replaces and removes
nothing else: a hidden file in each, with the SHA-256 of each file of its own.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterable
from pathlib import Path

from pp_cl.errors import UserError

# A line of JSON [path in the folder, SHA-256] for each file, in the order of writing; null stands
# for a file that changes in place. Lines are added before a file gets its name, and stay: a kill in
# between leaves a line too much, which says nothing of a file of others.
MANIFEST = ".pp-cl-files.jsonl"
# of what is being written, with the number of its process
TEMPORARY = re.compile(r"\..+\.(\d+)\.pp-cl\.tmp(\..*)?", re.DOTALL)
AT_ONCE = 2**20  # bytes that are read


def begin_manifest(folder: Path) -> None:
    """Make a folder, where it is missing, one that the program fills."""
    folder.mkdir(parents=True, exist_ok=True)
    if not has_manifest(folder):
        (folder / MANIFEST).touch()


def has_manifest(folder: Path) -> bool:
    """Whether the program fills the folder."""
    return (folder / MANIFEST).is_file()


def note(file: Path, path: Path) -> None:
    """Add a file, or all in a folder, that is about to become `path`, to the manifest nearest above
    that, if there is one.
    """
    home = _home(path)
    if home is not None:
        files = [one for one in file.rglob("*") if one.is_file()] if file.is_dir() else [file]
        _add(home, [(path / one.relative_to(file), _digest(one)) for one in sorted(files)])


def note_in_place(home: Path, paths: Iterable[Path]) -> None:
    """The same of files that change in place, before they are there, in the manifest of the folder
    `home`: they are the program's, whatever they hold. Raises UserError as check_ours does.
    """
    paths = list(paths)
    check_ours(paths)
    _add(home, [(path, None) for path in paths])


def ours(paths: Iterable[Path]) -> list[Path]:
    """Those of the files that are as the program has written them."""
    known: dict[Path, set] = {}
    found = []
    for path in paths:
        home = _home(path)
        if home is None or path.is_symlink() or not path.is_file():
            continue
        if home not in known:
            known[home] = set((home / MANIFEST).read_bytes().splitlines())
        lines = {_line(home, path, None), _line(home, path, _digest(path))}
        if lines & known[home]:
            found.append(path)
    return found


def check_ours(paths: Iterable[Path], mend: str = "move it away") -> None:
    """Raise UserError naming the first file that is there and not ours(): it would be lost.

    mend: what to do about it.
    """
    there = [path for path in paths if os.path.lexists(path)]
    if others := set(there) - set(ours(there)):
        first = min(others)
        raise UserError(f"{first}: pp-cl did not write this, or not as it is now; {mend}")


def remove_ours(paths: Iterable[Path]) -> None:
    """Remove those of the files that are ours(), and the folders that are empty without them."""
    for path in ours(paths):
        home = _home(path)
        path.unlink()
        for folder in path.parents:
            if folder.absolute() == home or any(folder.iterdir()):
                break
            folder.rmdir()


def _home(path):
    """The folder nearest above a path that the program fills, None where there is none, or a folder
    in between is not finished, of which all is noted at its end.
    """
    for folder in Path(os.path.abspath(path)).parents:
        if has_manifest(folder):
            return folder
        if TEMPORARY.fullmatch(folder.name):
            return None
    return None


def _digest(path):
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while part := file.read(AT_ONCE):
            digest.update(part)
    return digest.hexdigest()


def _line(home, path, digest):
    """A line of a manifest, without its end."""
    relative = Path(os.path.abspath(path)).relative_to(os.path.abspath(home))
    return json.dumps([relative.as_posix(), digest]).encode()


def _add(home, entries):
    """Add the (path, digest) that are not there yet."""
    before = (home / MANIFEST).read_bytes()
    known = set(before.splitlines())
    new = [line for entry in entries if (line := _line(home, *entry)) not in known]
    if new:
        cut = not before.endswith(b"\n") and before  # a line of a process that was killed
        with open(home / MANIFEST, "ab") as file:
            file.write(b"".join(line + b"\n" for line in [b""] * bool(cut) + new))
            file.flush()
            os.fsync(file.fileno())
