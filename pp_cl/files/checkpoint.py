"""The file format of checkpoints: a .npz of uncompressed arrays and a JSON header, written
atomically and checked when read.
"""

import errno
import io
import json
import math
import stat
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from pp_cl.errors import Diverged, UserError, quoted, shown
from pp_cl.files.atomic import atomic_file
from pp_cl.files.untrusted import strict_json

FORMAT = 1  # raised when the arrays change meaning
MOST_HEADER = 2**24  # bytes
MEND = "delete it to train anew, or restore a copy"

PIECE_BYTES = 2**24
# bytes of a zip's directory: each entry takes about ten times its part of it as zipfile keeps it
MOST_DIRECTORY = 2**24


class Rows(Protocol):
    """An array that comes in pieces, as device/buffers.py has them."""

    shape: tuple[int, ...]
    dtype: np.dtype

    def pieces(self) -> Iterator[np.ndarray]:
        """Its rows, some at a time."""


def save_checkpoint(
    path: Path | str, header: dict[str, Any], arrays: Mapping[str, np.ndarray | Rows]
) -> None:
    """Write {name: array} and a JSON header as np.savez does, without a copy of a whole array. The
    same content gives the same bytes: no times are stored. Raises Diverged for NaN and Inf,
    UserError for a header that is too large to be read, and leaves the file as it was.
    """
    text = json.dumps({"format": FORMAT, **header}, sort_keys=True).encode()
    if len(text) > MOST_HEADER:
        raise UserError(
            f"{path}: its header would have {len(text)} bytes, more than the {MOST_HEADER} that are"
            " read; train on fewer photographs"
        )
    with atomic_file(path, noted=False) as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in {"header": np.frombuffer(text, np.uint8), **arrays}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                kind = np.lib.format.dtype_to_descr(array.dtype)
                facts = {"descr": kind, "fortran_order": False, "shape": tuple(array.shape)}
                np.lib.format.write_array_header_1_0(member, facts)
                for piece in _finite_pieces(name, array):
                    member.write(np.ascontiguousarray(piece).reshape(-1).view(np.uint8).data)


def check_finite(arrays: Mapping[str, np.ndarray | Rows]) -> None:
    """Raise Diverged naming the first array that holds NaN or Inf."""
    for name, array in arrays.items():
        for _ in _finite_pieces(name, array):
            pass


def _finite_pieces(name, array):
    for piece in [array] if isinstance(array, np.ndarray) else array.pieces():
        _check_piece(name, piece)
        yield piece


def _check_piece(name, piece):
    if piece.dtype.kind == "f" and not np.isfinite(piece).all():
        raise Diverged(f"{name} holds NaN or Inf")


# Reading ------------------------------------------------------------------------------------------


class Form(NamedTuple):
    """What an array is before it is read."""

    shape: tuple[int, ...]
    dtype: np.dtype

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"


class Checkpoint:
    """An opened checkpoint. header: its JSON object; forms: {name: Form} of the other arrays, none
    of which has been read. Every array is as large as its part of the file, and no part is of two.

    Raises ValueError, and what zipfile raises, for anything else than save_checkpoint() writes.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self.path, self._archive = path, archive
        self.forms: dict[str, Form] = {}
        self._starts: dict[str, int] = {}
        entries = archive.infolist()
        for entry in entries:
            self._add(entry)
        if sum(entry.file_size for entry in entries) > path.stat().st_size:
            raise ValueError("two of its arrays share a part of the file")
        self.header = self._read_header()

    def _add(self, entry):
        name = entry.filename.removesuffix(".npy")
        if name == entry.filename or name in self.forms:
            raise ValueError(f"holds {shown(entry.filename, 40)}, which does not belong there")
        stored = entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1
        if not stored or entry.file_size != entry.compress_size:
            raise ValueError(f"{shown(name, 40)} is not stored as it is")
        with self._archive.open(entry) as member:
            form, start = _read_form(member)
        if start + math.prod(form.shape) * form.dtype.itemsize != entry.file_size:
            raise ValueError(f"{shown(name, 40)} is not as large as {form}")
        self.forms[name], self._starts[name] = form, start

    def _read_header(self):
        """The header, of a format that is read."""
        form = self.forms.get("header")
        if form is None or form.dtype != np.uint8 or math.prod(form.shape) > MOST_HEADER:
            raise ValueError("it has no header")
        header = strict_json(self._read("header").tobytes())
        if not isinstance(header, dict):
            raise ValueError("its header is no JSON object")
        if header.get("format") != FORMAT:
            found = quoted(header.get("format"), 40)
            raise UserError(f"{self.path}: format {found}, this version reads {FORMAT}; train anew")
        del self.forms["header"]
        return header

    def _read(self, name):
        form = self.forms[name]
        array = np.empty(form.shape, form.dtype)
        values = memoryview(array.reshape(-1).view(np.uint8))
        with self._archive.open(f"{name}.npy") as member:
            member.read(self._starts[name])
            for first in range(0, len(values), PIECE_BYTES):
                piece = values[first : first + PIECE_BYTES]
                piece[:] = member.read(len(piece))
        return array

    def array(self, name: str) -> np.ndarray:
        """One of its arrays. Raises UserError naming file and array where it cannot be read, or
        holds NaN or Inf.
        """
        with _refused(self.path):
            array = self._read(name)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise UserError(f"{self.path}: {name} holds NaN or Inf; {MEND}")
        return array


def _read_form(member):
    """(Form, bytes before the values) of an opened array."""
    if np.lib.format.read_magic(member) != (1, 0):  # others have headers of up to 4 GiB
        raise ValueError("holds an array of another version than 1.0")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(member)
    if by_columns or dtype.kind not in "fiu" or dtype.byteorder == ">" or min(shape, default=0) < 0:
        raise ValueError("holds an array of another kind than numbers row by row")
    return Form(shape, dtype), member.tell()


@contextmanager
def opened_checkpoint(path: Path | str) -> Iterator[Checkpoint]:
    """The checkpoint, until the block ends. training/checkpoint.py compares it with its
    run's settings.

    Raises UserError naming the file when it is missing, truncated, corrupt or of another format.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint; train first")
    with ExitStack() as stack:
        with _refused(path):
            checkpoint = Checkpoint(path, stack.enter_context(opened_zip(path)))
        yield checkpoint


def load_checkpoint(path: Path | str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(header, {name: numpy array}) of a checkpoint of any run. Raises UserError as
    opened_checkpoint and Checkpoint.array do.
    """
    with opened_checkpoint(path) as stored:
        return stored.header, {name: stored.array(name) for name in stored.forms}


@contextmanager
def _refused(path):
    """What is wrong with the file becomes a UserError; zipfile meets broken bytes with whatever
    comes up.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # a place before the file
            raise UserError(
                f"{path}: cannot be read ({error.strerror or error}); check its permissions and the"
                " disk"
            ) from None
        reason = shown(str(error)) or type(error).__name__
        raise UserError(f"{path}: corrupt checkpoint ({reason}); {MEND}") from None


class _Pieces(io.FileIO):
    """An opened file, of which at most MOST_DIRECTORY bytes are read at once."""

    def read(self, size: int | None = -1) -> bytes:
        if size is not None and size > MOST_DIRECTORY:
            raise ValueError(f"its directory is larger than {MOST_DIRECTORY} bytes")
        return super().read(size)


@contextmanager
def opened_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """The zip file, until the block ends. Raises OSError where it cannot be read, ValueError
    for a directory of more than MOST_DIRECTORY bytes, and what zipfile raises.
    """
    if stat.S_ISFIFO(path.stat().st_mode):  # it would never end
        raise ValueError("is no regular file")
    with _Pieces(path) as file, zipfile.ZipFile(file) as archive:
        yield archive
