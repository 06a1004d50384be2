"""Checkpoints: written to a temporary name, synced, renamed; read without trust."""

import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pp_cl.errors import Diverged, UserError, quoted, shown
from pp_cl.files.atomic import atomic_file
from pp_cl.files.npz import NpzFile

FORMAT = 1  # raised when the arrays change meaning
MOST_HEADER = 2**24  # bytes; the measurements of a tuned device take some 100,000
MEND = "delete it to train anew, or restore a copy"


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
    same content gives the same bytes: no times are stored. Raises Diverged for NaN and Inf, and
    leaves the file as it was.
    """
    text = json.dumps({"format": FORMAT, **header}, sort_keys=True).encode()
    with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in {"header": np.frombuffer(text, np.uint8), **arrays}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                _write_array(member, name, array)


def check_finite(arrays: Mapping[str, np.ndarray | Rows]) -> None:
    """Raise Diverged naming the first array that holds NaN or Inf."""
    for name, array in arrays.items():
        for piece in _pieces(array):
            _check_piece(name, piece)


def _check_piece(name, piece):
    if piece.dtype.kind == "f" and not np.isfinite(piece).all():
        raise Diverged(f"{name} holds NaN or Inf")


def _pieces(array):
    return [array] if isinstance(array, np.ndarray) else array.pieces()


def _write_array(member, name, array):
    kind = np.lib.format.dtype_to_descr(array.dtype)
    facts = {"descr": kind, "fortran_order": False, "shape": tuple(array.shape)}
    np.lib.format.write_array_header_1_0(member, facts)
    for piece in _pieces(array):
        _check_piece(name, piece)
        member.write(np.ascontiguousarray(piece).reshape(-1).view(np.uint8))


class Checkpoint:
    """An opened checkpoint. header: its JSON object; forms: {name: Form} of the other arrays, none
    of which has been read.
    """

    def __init__(self, path: Path, file: NpzFile) -> None:
        self.path = path
        self.forms = {name: form for name, form in file.forms.items() if name != "header"}
        self._file = file
        self.header = self._read_header()

    def array(self, name: str) -> np.ndarray:
        """One of its arrays. Raises UserError naming file and array where it cannot be read, or
        holds NaN or Inf.
        """
        with _refused(self.path):
            array = self._file.read(name)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise UserError(f"{self.path}: {name} holds NaN or Inf; {MEND}")
        return array

    def _read_header(self):
        """The header, of a format that is read."""
        with _refused(self.path):
            form = self._file.forms.get("header")
            if form is None or form.dtype != np.uint8 or math.prod(form.shape) > MOST_HEADER:
                raise ValueError("it has no header")
            text = self._file.read("header").tobytes()
            header = json.loads(text, parse_constant=_refuse_constant)
            if not isinstance(header, dict):
                raise ValueError("its header is no JSON object")
        if header.get("format") != FORMAT:
            found = quoted(header.get("format"), 40)
            raise UserError(f"{self.path}: format {found}, this version reads {FORMAT}; train anew")
        return header


@contextmanager
def opened_checkpoint(path: Path | str) -> Iterator[Checkpoint]:
    """The checkpoint, until the block ends. training/checkpoint.py compares it with its
    run's settings.

    Raises UserError naming the file when it is missing, truncated, corrupt or of another format.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint; train first")
    with _refused(path):
        file = NpzFile(path)
    try:
        yield Checkpoint(path, file)
    finally:
        file.close()


def load_checkpoint(path: Path | str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(header, {name: numpy array}) of a checkpoint of any run. Raises UserError as
    opened_checkpoint and Checkpoint.array do.
    """
    with opened_checkpoint(path) as stored:
        return stored.header, {name: stored.array(name) for name in stored.forms}


@contextmanager
def _refused(path):
    """What is wrong with the file becomes a UserError."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{path}: cannot be read ({error.strerror or error}); check its permissions and the"
            " disk"
        ) from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: corrupt checkpoint ({shown(str(error))}); {MEND}") from None


def _refuse_constant(name):
    raise ValueError(f"its header holds {name}")
