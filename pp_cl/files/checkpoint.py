"""The file format of checkpoints: a .npz of uncompressed arrays and a JSON header, written
atomically; what is read is compared with the size of its part of the file first.
"""

import errno
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from pp_cl.errors import Diverged, UserError, quoted, shown
from pp_cl.files.atomic import atomic_file
from pp_cl.files.untrusted import opened_zip, strict_json

FORMAT = 2  # raised when the arrays change meaning
MOST_HEADER = 2**24  # bytes; a view takes some 400
MEND = "delete it to train again, or restore a copy"


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
    of which has been read.

    Raises ValueError, and what zipfile raises, for anything else than save_checkpoint() writes.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self.path, self._archive = path, archive
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > path.stat().st_size:
            raise ValueError("it unfolds to more than the file holds")
        self.forms = {entry.filename.removesuffix(".npy"): self._form(entry) for entry in entries}
        text = self.forms.pop("header", None)
        if text is None or text.dtype != np.uint8 or math.prod(text.shape) > MOST_HEADER:
            raise ValueError("it has no header")
        self.header = strict_json(self._read("header").tobytes())
        if not isinstance(self.header, dict):
            raise ValueError("its header is no JSON object")
        if self.header.get("format") != FORMAT:
            found = quoted(self.header.get("format"), 40)
            raise UserError(f"{path}: format {found}, this version reads {FORMAT}; train again")

    def _form(self, entry):
        """The Form of an array, which is as large as its part of the file."""
        with self._archive.open(entry) as member:
            if np.lib.format.read_magic(member) != (1, 0):  # others have headers of up to 4 GiB
                raise ValueError("holds an array of another version than 1.0")
            shape, _, dtype = np.lib.format.read_array_header_1_0(member)
            if member.tell() + math.prod(shape) * dtype.itemsize != entry.file_size:
                raise ValueError(f"{shown(entry.filename, 40)} is not as large as {shape} {dtype}")
        return Form(shape, dtype)

    def _read(self, name):
        with self._archive.open(f"{name}.npy") as member:
            return np.lib.format.read_array(member, allow_pickle=False)

    def array(self, name: str) -> np.ndarray:
        """One of its arrays. Raises UserError naming file and array where it cannot be read, or
        holds NaN or Inf.
        """
        with _refused(self.path):
            array = self._read(name)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise UserError(f"{self.path}: {name} holds NaN or Inf; {MEND}")
        return array

    def arrays(self) -> dict[str, np.ndarray]:
        """{name: array} of all. Raises UserError as array() does."""
        return {name: self.array(name) for name in self.forms}


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
