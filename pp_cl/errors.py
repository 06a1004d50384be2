"""The exceptions that a user sees as one line, and functions that quote foreign text in it."""

import difflib
import os
import shlex
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path

MOST_LINE = 1000  # characters of a message: two long paths and a reason
NAMES_SHOWN = 3  # in a message; others are counted


def one_line(text: object, most: int = MOST_LINE) -> str:
    """A message that a terminal can show: on one line, without control characters, and without its
    middle if it is longer than `most` characters.
    """
    text = str(text)
    if len(text) > most:
        text = f"{text[: most - 400]} ... {text[5 - 400 :]}"
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


class UserError(Exception):
    """Bad input or environment. The message, one line, names the file (and key) and the remedy."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(message))


class Unusable(UserError):
    """One view of a scene cannot be used, but the others may do without it. why: the reason in a
    few words, the same for all views with this fault.
    """

    def __init__(self, message: object, why: str) -> None:
        super().__init__(message)
        self.why = why


BROKEN_CAMERA = "a camera that is broken"  # why of an Unusable


class Diverged(UserError):
    """The loss or an image of a training is no longer finite. The message says where."""


class BuildError(RuntimeError):
    """A driver cannot build a kernel file. The message is one line; log: the compiler's output."""

    def __init__(self, message: str, log: str) -> None:
        super().__init__(one_line(message))
        self.log = log


class Stopped(Exception):
    """A command ended in good order before it was done. The message says how to continue; status:
    the exit status, 128 plus the number of the signal that ended it, or 1.
    """

    def __init__(self, message: str, status: int) -> None:
        super().__init__(one_line(message))
        self.status = status


def require(what: str, *packages: str) -> None:
    """Raise UserError if one of the packages that `what` needs cannot be imported."""
    for package in packages:
        module = package.replace("-", "_")
        try:
            import_module(module)
        except Exception as error:  # a broken one may raise anything
            is_missing = isinstance(error, ModuleNotFoundError) and error.name == module
            broken = "" if is_missing else f" ({package} cannot be imported: {error})"
            raise UserError(
                f"{what} needs {' and '.join(packages)}{broken}; install with"
                f" `pip install {' '.join(packages)}`"
            ) from None


def name_of(folder: Path) -> str:
    """The name of a folder as valid Unicode; the name on disk may not be UTF-8."""
    return os.fsencode(folder.resolve().name).decode(errors="replace")


def shown(text: str, most: int = 100) -> str:
    """one_line() of foreign text, for a message, cut to at most `most` characters."""
    text = one_line(" ".join(text[: 4 * most].split()))
    return text if len(text) <= most else f"{text[: most - 3]}..."


def quoted(value: object, most: int = 100) -> str:
    """shown() of a value's repr(): strings get quotation marks."""
    try:
        return shown(repr(value), most)
    except (RecursionError, ValueError):  # nested deeply, or a number of thousands of digits
        return f"a {type(value).__name__}"


def few_names(names: Sequence[str]) -> str:
    """The first names, and the number of the others."""
    more = f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
    return ", ".join(names[:NAMES_SHOWN]) + more


def pasted(path: object) -> str:
    """A path as a word of a command that people may paste."""
    return shlex.quote(str(path))


def suggestion(word: str, words: Iterable[str]) -> str:
    """`did you mean X? `, with the near word that shares the longest run of letters, or ""."""
    word = word[:100]
    near = difflib.get_close_matches(word, list(words))
    near.sort(
        key=lambda near_word: (
            -difflib.SequenceMatcher(None, word, near_word).find_longest_match().size
        )
    )
    return f"did you mean {near[0]}? " if near else ""
