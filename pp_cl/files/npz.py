"""Arrays in .npz files as pp-cl writes them, stored uncompressed: the directory and the header of
every array are looked at before an array is read.
"""

import errno
import io
import math
import re
import stat
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pp_cl.errors import shown

MAGIC = b"\x93NUMPY\x01\x00"
MOST_HEADER = 1024  # bytes of an array's header; ours have 118
# as numpy writes it of numbers, row by row; to read it by this alone evaluates nothing
HEADER = re.compile(
    rb"\{'descr': '([<|][fiu][1248])', 'fortran_order': False,"
    rb" 'shape': \(((?:\d{1,15}, ?)*(?:\d{1,15})?)\), \} *\n"
)
PIECE_BYTES = 2**24
# bytes of a zip's directory: each entry takes about ten times its part of it as zipfile keeps it
MOST_DIRECTORY = 2**24


class _Pieces(io.FileIO):
    """An opened file, of which at most MOST_DIRECTORY bytes are read at once."""

    def read(self, size: int = -1) -> bytes:
        if size > MOST_DIRECTORY:
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


class Form(NamedTuple):
    """What an array is before it is read."""

    shape: tuple[int, ...]
    dtype: np.dtype

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"


class NpzFile:
    """An opened file. forms: {name: Form} of its arrays.

    Raises OSError where the file cannot be read, ValueError with the reason for anything else than
    a file as numpy's savez writes it. Every array is as large as its part of the file, and no part
    is of two.
    """

    def __init__(self, path: Path) -> None:
        self.forms: dict[str, Form] = {}
        self._starts: dict[str, int] = {}
        with ExitStack() as stack, _one_kind_of_error():
            self._archive = stack.enter_context(opened_zip(path))
            entries = self._archive.infolist()
            for entry in entries:
                self._add(entry)
            if sum(entry.file_size for entry in entries) > path.stat().st_size:
                raise ValueError("two of its arrays share a part of the file")
            self._close = stack.pop_all().close

    def close(self) -> None:
        """Close the file."""
        self._close()

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

    def read(self, name: str) -> np.ndarray:
        """An array. Raises OSError and ValueError as above, for a wrong checksum too."""
        form = self.forms[name]
        array = np.empty(form.shape, form.dtype)
        values = memoryview(array.reshape(-1).view(np.uint8))
        with _one_kind_of_error(), self._archive.open(f"{name}.npy") as member:
            member.read(self._starts[name])
            for first in range(0, len(values), PIECE_BYTES):
                piece = values[first : first + PIECE_BYTES]
                piece[:] = member.read(len(piece))
        return array


@contextmanager
def _one_kind_of_error() -> Iterator[None]:
    """zipfile meets broken bytes with whatever comes up: it becomes a ValueError."""
    try:
        yield
    except Exception as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # a place before the file
            raise
        raise ValueError(shown(str(error)) or type(error).__name__) from None


def _read_form(member):
    """(Form, bytes before the values) of an opened array."""
    start = member.read(len(MAGIC) + 2)
    length = int.from_bytes(start[len(MAGIC) :], "little")
    if not start.startswith(MAGIC) or length > MOST_HEADER:
        raise ValueError("holds a file that is no array")
    found = HEADER.fullmatch(member.read(length))
    if not found:
        raise ValueError("holds an array of another kind than numbers row by row")
    kind, sizes = (text.decode() for text in found.groups())
    shape = tuple(int(size) for size in sizes.split(",") if size.strip())
    return Form(shape, np.dtype(kind)), len(start) + length
