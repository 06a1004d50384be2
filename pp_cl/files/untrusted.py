"""Opens files of other programs, after checking that they are regular files and small enough."""

import codecs
import errno
import json
import os
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from pp_cl.errors import UserError, shown

MOST_REASON = 120  # characters
UTF_16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
MOST_VALUES = 2**22  # in a JSON file: 100,000 cameras of 40; with the text, 1 GiB at most
# bytes of a zip file's directory; in zipfile's memory it takes about ten times as much
MOST_DIRECTORY = 2**24
MOST_PIXELS = 2 * 89_478_485  # Pillow refuses larger images; the largest sensors have 151 M


@contextmanager
def opened_regular(path: Path | str) -> Iterator[BinaryIO]:
    """The opened file. Raises OSError if it is missing, a folder, or an endless pipe or device."""
    # Windows keeps no named pipes in folders, but without O_BINARY it translates line ends
    flags = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    descriptor = os.open(path, os.O_RDONLY | flags)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.ENOTSUP, "Not a regular file", str(path))
    with open(descriptor, "rb") as file:
        yield file


@contextmanager
def opened_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """The zip file, opened until the block ends. Raises OSError as opened_regular() does,
    ValueError for a large directory, and zipfile's exceptions.
    """
    with opened_regular(path) as file:
        # zipfile reads as much at once as the record at the file's end says
        end = zipfile._EndRecData(file)  # type: ignore[attr-defined]
        if end is not None and end[zipfile._ECD_SIZE] > MOST_DIRECTORY:  # type: ignore[attr-defined]
            raise ValueError(f"its directory is larger than {MOST_DIRECTORY} bytes")
        with zipfile.ZipFile(file) as archive:
            yield archive


def read_regular(
    path: Path | str, most: int, encoding: str = "utf-8", errors: str = "strict"
) -> str:
    """The text of a file of at most `most` bytes; UTF-16 is recognised by its byte order mark.
    encoding, errors: as in bytes.decode(). Raises OSError as opened_regular() does, and ValueError
    for a larger file.
    """
    with opened_regular(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"larger than {most} bytes")
    return content.decode("utf-16" if content.startswith(UTF_16) else encoding, errors)


def read_json_text(
    path: Path | str, most: int, encoding: str = "utf-8", errors: str = "strict"
) -> str:
    """read_regular() for JSON with at most MOST_VALUES values, since a value such as {} may take a
    hundred times the memory of its text. Raises ValueError for more.
    """
    text = read_regular(path, most, encoding, errors)
    if sum(map(text.count, ",[{")) > MOST_VALUES:
        raise ValueError(f"more than {MOST_VALUES} values")
    return text


def strict_json(text: bytes | str) -> Any:
    """The value of a JSON text. Raises ValueError for invalid JSON, such as NaN and Infinity."""
    return json.loads(text, parse_constant=_refuse_constant)


def _refuse_constant(name):
    raise ValueError(f"holds {name}, which is not a JSON number")


def refusal(
    path: Path | str, error: Exception, kind: str, mend: str = "copy it again"
) -> UserError:
    """A UserError about a file that could not be read as `kind`, or not at all."""
    if isinstance(error, FileNotFoundError):
        return UserError(f"{path}: no such file; copy it there")
    # these errors come from the content, which names a place beyond the file's end
    is_content = (None, errno.EINVAL, errno.EOVERFLOW)
    if isinstance(error, OSError) and error.errno not in is_content:
        return UserError(
            f"{path}: cannot be read ({error.strerror}); check its permissions and the disk"
        )
    if isinstance(error, UnicodeDecodeError) and error.encoding == "utf-8":
        return UserError(f"{path}: is not UTF-8 text; save it as UTF-8, or {mend}")
    reason = shown(str(error), MOST_REASON) or type(error).__name__
    return UserError(f"{path}: cannot be read as {kind} ({reason}); {mend}")
