"""Where an export goes: checked before the work begins."""

import os
from pathlib import Path

from pp_cl.errors import UserError


def check_file(path: Path, suffixes: tuple[str, ...]) -> None:
    """Raise UserError where the path is a folder or has none of the suffixes."""
    if path.is_dir():
        raise UserError(f"--out {path}: is a folder; name a file, as {path / ('x' + suffixes[0])}")
    if path.suffix.lower() not in suffixes:
        raise UserError(f"--out {path}: name a file that ends in {' or '.join(suffixes)}")


def check_parent(path: Path) -> None:
    """Raise UserError unless the folder of a path exists and may be written."""
    parent = path.parent
    if not parent.is_dir():
        raise UserError(f"--out {path}: {parent} is no folder; make it first")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise UserError(f"--out {path}: {parent} may not be written; choose another folder")
