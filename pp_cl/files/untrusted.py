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
MOST_VALUES = 2**22  # of a JSON file: 100,000 cameras of 40; with its text they take 1 GiB at most
# bytes of a zip's directory: each file in it takes about ten times its part of it as zipfile keeps
# it
MOST_DIRECTORY = 2**24
MOST_PIXELS = 2 * 89_478_485  # of an image; Pillow refuses more. The largest sensors have 151 M


@contextmanager
def opened_regular(path: Path | str) -> Iterator[BinaryIO]:
    """The opened file. Raises OSError for none, a folder, and pipes and devices, without an end."""
    # Windows has no pipes with names in folders, but translates line ends unless told not to
    flags = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    descriptor = os.open(path, os.O_RDONLY | flags)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.ENOTSUP, "Not a regular file", str(path))
    with open(descriptor, "rb") as file:
        yield file


@contextmanager
def opened_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """The zip file, until the block ends. Raises OSError as opened_regular, ValueError for a large
    directory, and what zipfile raises.
    """
    with opened_regular(path) as file:
        # what zipfile itself finds at the file's end says how much it will read at once
        end = zipfile._EndRecData(file)  # type: ignore[attr-defined]
        if end is not None and end[zipfile._ECD_SIZE] > MOST_DIRECTORY:  # type: ignore[attr-defined]
            raise ValueError(f"its directory is larger than {MOST_DIRECTORY} bytes")
        with zipfile.ZipFile(file) as archive:
            yield archive


def read_regular(
    path: Path | str, most: int, encoding: str = "utf-8", errors: str = "strict"
) -> str:
    """The text of a file of at most so many bytes; UTF-16 is known by its byte order mark. errors:
    what other bytes become. Raises OSError as opened_regular, ValueError for a larger file.
    """
    with opened_regular(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"larger than {most} bytes")
    return content.decode("utf-16" if content.startswith(UTF_16) else encoding, errors)


def read_json_text(
    path: Path | str, most: int, encoding: str = "utf-8", errors: str = "strict"
) -> str:
    """read_regular() of JSON of at most MOST_VALUES values, of which each may take a hundred times
    the memory of its text, such as {}. Raises ValueError for more.
    """
    text = read_regular(path, most, encoding, errors)
    if sum(map(text.count, ",[{")) > MOST_VALUES:
        raise ValueError(f"more than {MOST_VALUES} values")
    return text


def strict_json(text: bytes | str) -> Any:
    """The value of JSON. Raises ValueError for what is none, NaN and Infinity among it."""
    return json.loads(text, parse_constant=_refuse_constant)


def _refuse_constant(name):
    raise ValueError(f"holds {name}, which is no number")


def refusal(
    path: Path | str, error: Exception, kind: str, mend: str = "copy it again"
) -> UserError:
    """The UserError about a file that could not be read as `kind`, or for the system not at all."""
    if isinstance(error, FileNotFoundError):
        return UserError(f"{path}: no such file; copy it there")
    # the content names a place that no file has
    is_content = (None, errno.EINVAL, errno.EOVERFLOW)
    if isinstance(error, OSError) and error.errno not in is_content:
        return UserError(
            f"{path}: cannot be read ({error.strerror}); check its permissions and the disk"
        )
    if isinstance(error, UnicodeDecodeError) and error.encoding == "utf-8":
        return UserError(f"{path}: is no text in UTF-8; save it as UTF-8, or {mend}")
    reason = shown(str(error), MOST_REASON) or type(error).__name__
    return UserError(f"{path}: cannot be read as {kind} ({reason}); {mend}")
