"""Files of a run: written to a temporary name, synced, renamed; read without trust."""

import errno
import json
import os
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError

FORMAT = 1  # raised when the arrays change meaning


@contextmanager
def atomic_file(path):
    """A binary file object whose content appears under `path` only when the block ends well.

    Raises UserError naming the file when the disk is full or may not be written; nothing half-written stays behind.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        mend = "free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "check the folder and its permissions"
        raise UserError(f"{path}: cannot be written ({error.strerror}); {mend}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _sync_folder(folder):
    """Make a rename in the folder survive a power cut, where the system knows how."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path, text):
    """Write a text file atomically."""
    with atomic_file(path) as file:
        file.write(text.encode())


def write_json(path, value):
    """Write JSON atomically; NaN and Inf are refused with ValueError."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def remove_leftovers(folder):
    """Delete temporary files that a killed process left in the folder."""
    for leftover in Path(folder).glob(".*.tmp"):
        leftover.unlink(missing_ok=True)


def save_checkpoint(path, header, arrays):
    """Write {name: numpy array} and a JSON header. The same content gives the same bytes: no times are stored."""
    meta = np.frombuffer(json.dumps({"format": FORMAT, **header}, sort_keys=True).encode(), np.uint8)
    with atomic_file(path) as file:
        np.savez(file, header=meta, **arrays)


def load_checkpoint(path):
    """(header, {name: numpy array}) of a checkpoint.

    Raises UserError naming the file when it is missing, truncated, corrupt, of another format, or holds NaN or Inf.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint; train first")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop("header").tobytes())
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, RuntimeError) as error:
        raise UserError(
            f"{path}: corrupt checkpoint ({' '.join(str(error).split())[:100]}); delete it to train anew, or restore a copy"
        ) from None
    if header.get("format") != FORMAT:
        raise UserError(f"{path}: format {header.get('format')}, this version reads {FORMAT}; train anew")
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise UserError(f"{path}: {name} holds NaN or Inf; delete it to train anew, or restore a copy")
    return header, arrays
