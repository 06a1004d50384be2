"""Files of a run: written to a temporary name, synced, renamed; read without trust."""

import json
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file

FORMAT = 1  # raised when the arrays change meaning


class Rows(Protocol):
    """An array that comes in pieces, as device/rows.py has them."""

    shape: tuple[int, ...]
    dtype: np.dtype

    def pieces(self) -> Iterator[np.ndarray]:
        """Its rows, some at a time."""


def save_checkpoint(
    path: Path | str, header: dict[str, Any], arrays: Mapping[str, np.ndarray | Rows]
) -> None:
    """Write {name: array} and a JSON header as np.savez does, without a copy of a whole array. The
    same content gives the same bytes: no times are stored.
    """
    text = json.dumps({"format": FORMAT, **header}, sort_keys=True).encode()
    with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in {"header": np.frombuffer(text, np.uint8), **arrays}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                _write_array(member, array)


def _write_array(member, array):
    kind = np.lib.format.dtype_to_descr(array.dtype)
    facts = {"descr": kind, "fortran_order": False, "shape": tuple(array.shape)}
    np.lib.format.write_array_header_1_0(member, facts)
    for piece in [array] if isinstance(array, np.ndarray) else array.pieces():
        member.write(np.ascontiguousarray(piece).reshape(-1).view(np.uint8))


def load_checkpoint(path: Path | str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(header, {name: numpy array}) of a checkpoint.

    Raises UserError naming the file when it is missing, truncated, corrupt, of another format, or
    holds NaN or Inf.
    """
    with _opened(path) as stored:
        arrays = {name: stored[name] for name in stored.files if name != "header"}
        header = _header(stored, path)
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise UserError(
                f"{path}: {name} holds NaN or Inf; delete it to train anew, or restore a copy"
            )
    return header, arrays


def checkpoint_shapes(path: Path | str) -> tuple[dict[str, Any], dict[str, tuple[int, ...]]]:
    """(header, {name: shape}) of a checkpoint, whose arrays are not read. Raises UserError as
    load_checkpoint does, NaN and Inf aside.
    """
    with _opened(path) as stored:
        header, shapes = _header(stored, path), {}
        for name in stored.files:
            with stored.zip.open(f"{name}.npy") as member:
                np.lib.format.read_magic(member)
                shapes[name] = np.lib.format.read_array_header_1_0(member)[0]
    del shapes["header"]
    return header, shapes


def checkpoint_array(path: Path | str, name: str) -> np.ndarray:
    """One array of a checkpoint. Raises UserError naming the file where it is missing or
    corrupt.
    """
    with _opened(path) as stored:
        return stored[name]


@contextmanager
def _opened(path):
    """The archive of a checkpoint; what is wrong with it becomes a UserError."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint; train first")
    try:
        with np.load(path, allow_pickle=False) as stored:
            yield stored
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, RuntimeError) as error:
        raise UserError(
            f"{path}: corrupt checkpoint ({' '.join(str(error).split())[:100]}); delete it to train"
            " anew, or restore a copy"
        ) from None


def _header(stored, path):
    """The header, of a format that is read."""
    header = json.loads(stored["header"].tobytes())
    if header.get("format") != FORMAT:
        raise UserError(
            f"{path}: format {header.get('format')}, this version reads {FORMAT}; train anew"
        )
    return header


def fitting_array(
    arrays: dict[str, np.ndarray],
    name: str,
    shape: tuple[int, ...],
    file: Path,
    *,
    dtype: type = np.float32,
) -> np.ndarray:
    """The array called `name`, contiguous, taken out of `arrays`, so that its memory can be freed.
    Raises UserError naming the file and the array where it is missing or has another shape or
    dtype.
    """
    array = arrays.pop(name, None)
    if array is None or array.shape != tuple(shape) or array.dtype != dtype:
        found = "missing" if array is None else f"{array.dtype} {array.shape}"
        raise UserError(
            f"{file}: {name} is {found}, expected {np.dtype(dtype)} {tuple(shape)}; "
            "its config.json may belong to another run"
        )
    return np.ascontiguousarray(array)
