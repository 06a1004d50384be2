"""Arrays in .npz files as pp-cl writes them, stored uncompressed: the directory and the header of
every array are looked at before an array is read.
"""

import errno
import math
import re
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
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


class Form(NamedTuple):
    """What an array is before it is read."""

    shape: tuple[int, ...]
    dtype: np.dtype

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"


class NpzFile:
    """An opened file. forms: {name: Form} of its arrays.

    Raises OSError where the file cannot be read, ValueError with the reason for anything else than
    a file as numpy's savez writes it. Every array is as large as its part of the file.
    """

    def __init__(self, path: Path) -> None:
        found = path.stat()
        if stat.S_ISFIFO(found.st_mode):  # it would never end
            raise ValueError("is no regular file")
        with _one_kind_of_error():
            self._archive = zipfile.ZipFile(path)
        self.forms: dict[str, Form] = {}
        self._starts: dict[str, int] = {}
        try:
            with _one_kind_of_error():
                for entry in self._archive.infolist():
                    self._add(entry, found.st_size)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._archive.close()

    def _add(self, entry, file_size):
        name = entry.filename.removesuffix(".npy")
        if name == entry.filename or name in self.forms:
            raise ValueError(f"holds {shown(entry.filename, 40)}, which does not belong there")
        stored = entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1
        if not stored or entry.file_size != entry.compress_size or entry.file_size > file_size:
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
