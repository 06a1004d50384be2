"""Arrays in files of numpy and of text that other people made, checked before they are believed."""

import lzma
import math
import struct
import zipfile
import zlib
from pathlib import Path
from tokenize import TokenError

import numpy as np

from pp_cl.errors import UserError, shown
from pp_cl.files.npz import opened_zip
from pp_cl.files.regular import opened_regular, refusal

MOST_BYTES = 2**25  # of all arrays of a file, as float64: 100,000 cameras need some 25 million
MOST_TEXT = 2**20  # bytes of a file with the numbers of one camera
MOST = 1e30  # larger numbers are refused: float32 could not hold their products
KINDS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # of numpy's savez and savez_compressed
# What numpy and zipfile raise for bytes that are no array, besides the errors that say so.
BROKEN = (
    OSError,
    ValueError,
    EOFError,
    SyntaxError,
    TokenError,
    TypeError,
    OverflowError,
    RuntimeError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
)


def read_npy(file: Path) -> np.ndarray:
    """The array of a .npy file as float64. Raises UserError naming the file."""
    try:
        with opened_regular(file) as opened:
            return _checked(file, "", _read(opened, MOST_BYTES))
    except FileNotFoundError:
        raise UserError(f"{file}: no such file; copy it there") from None
    except BROKEN as error:
        raise _unreadable(file, error) from None


def read_npz(file: Path, wanted: str) -> dict[str, np.ndarray]:
    """{name: array as float64} of the members of a .npz file whose names begin with `wanted`.
    Raises UserError naming the file and the member.
    """
    try:
        arrays, left = {}, MOST_BYTES
        with opened_zip(file) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                if name == entry.filename or not name.startswith(wanted):
                    continue
                if entry.compress_type not in KINDS:  # others take memory of their own
                    raise ValueError(f"{name} is packed as numpy does not")
                with archive.open(entry) as opened:
                    arrays[name] = _checked(file, f"{name}: ", _read(opened, left))
                left -= arrays[name].nbytes
        return arrays
    except FileNotFoundError:
        raise UserError(f"{file}: no such file; copy it there") from None
    except BROKEN as error:
        raise _unreadable(file, error) from None


def _read(opened, most):
    """The array of an opened .npy file, of numbers and of at most so many bytes as float64."""
    if np.lib.format.read_magic(opened) != (1, 0):  # others have headers of up to 4 GiB
        raise ValueError("is of another version than 1.0")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(opened)
    if dtype.kind not in "fiu":
        raise ValueError(f"holds {dtype}, no numbers")
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * max(dtype.itemsize, 8) > most:
        raise ValueError(f"claims the shape {shown(str(shape), 40)}, more than {MOST_BYTES} bytes")
    data = opened.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize:
        raise ValueError("ends too early")
    array = np.frombuffer(data, dtype, count)
    return array.reshape(shape, order="F" if fortran else "C").astype(np.float64)


def _checked(file, name, array):
    if not (np.abs(array) < MOST).all():
        raise UserError(f"{file}: {name}holds NaN, Inf or a huge number; write it anew")
    return array


def _unreadable(file, error):
    if isinstance(error, UserError):
        return error
    return refusal(file, error, "numpy's arrays")


def read_numbers(file: Path) -> list[list[float]]:
    """The numbers of each line of a text file that has some. Raises UserError naming the file and
    the line.
    """
    if not file.is_file():
        raise UserError(f"{file}: no such file; copy it there")
    try:
        if file.stat().st_size > MOST_TEXT:
            raise UserError(f"{file}: is longer than cameras are; copy it anew")
        lines = file.read_text("utf-8").split("\n")
    except (OSError, ValueError) as error:
        raise refusal(file, error, "text") from None
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            values = [float(word) for word in line.split()]
        except ValueError:
            raise UserError(
                f"{file}: line {number}: {line[:60]!r} are no numbers; write it anew"
            ) from None
        if not all(abs(value) < MOST for value in values):
            raise UserError(
                f"{file}: line {number}: holds NaN, Inf or a huge number; write it anew"
            )
        if values:
            rows.append(values)
    return rows
