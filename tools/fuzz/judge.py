"""What is right of an input: taken and sound, or refused in one line with exit status 2."""

import contextlib
import io
import json
import math
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

from pp_cl.cli import main
from pp_cl.errors import UserError

ENDS = (0, 2, 130)  # exit statuses that a user may see
MOST_MESSAGE = 1500  # characters of a refusal: two paths and a reason
OURS = ("pp_cl", "fuzz")  # in the path of a module to which pp-cl's own warnings point


class Finding(Exception):
    """Something that is not as it should be, in one line, by which findings are told apart."""


class Case:
    """One input. rng: that it is drawn with; folder: of its own, empty; world: templates and the
    device, see templates.World. label: what was done.
    """

    def __init__(self, rng: Random, folder: Path, world: Any) -> None:
        self.rng, self.folder, self.world, self.label = rng, folder, world, ""

    def read(self, function: Callable[[], Any]) -> Any:
        """What the function returns, or None where it refuses. Raises Finding for a refusal that is
        no line, and for others' warnings.
        """
        with _watched():
            try:
                return function()
            except UserError as error:
                check_line(str(error))
            except OSError:  # of which the command line makes a line
                pass
        return None

    def command(self, *words: Any) -> int:
        """The exit status of the command line, called as the script calls it."""
        out, err = io.StringIO(), io.StringIO()
        with _watched(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = main([str(word) for word in words])
            except SystemExit as end:  # --help
                status = end.code or 0
        if status not in ENDS:
            raise Finding(f"exit status {status}")
        lines = [line for line in err.getvalue().splitlines() if line]
        errors = [line for line in lines if line.startswith("pp-cl")]
        if status == 2 and (not errors or errors[-1] != lines[-1]):
            raise Finding(f"refused with another last line than pp-cl's: {lines[-1:]}")
        if status == 2:
            check_line(errors[-1])
        return status


@contextlib.contextmanager
def _watched():
    """Warnings that are not pp-cl's own become a Finding, as does a lack of memory."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", append=True)  # behind what is left out on purpose
        try:
            yield
        except MemoryError as error:
            raise Finding(f"MemoryError at {stack(error)}") from error
    for one in caught:
        if one.category is UserWarning and any(part in one.filename for part in OURS):
            check_line(str(one.message))
        else:
            place = f"{Path(one.filename).name}:{one.lineno}"
            raise Finding(f"{one.category.__name__} at {place}: {str(one.message)[:90]}")


def check_line(message: str) -> None:
    """Raise Finding unless a message is one line that a terminal shows."""
    if not message.isprintable():
        raise Finding(f"a message with control characters: {message[:160]!r}")
    if len(message) > MOST_MESSAGE:
        raise Finding(f"a message of more than {MOST_MESSAGE} letters: {message[:160]!r}")


def stack(error: BaseException) -> str:
    """The innermost places of an exception inside pp_cl, by which findings are told apart."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "pp_cl" in f.filename]
    found = dict.fromkeys(f"{Path(f.filename).name}:{f.lineno}" for f in frames)
    return " > ".join(list(found)[-2:])


def check(right: bool, what: str) -> None:
    """Raise Finding about nonsense that was accepted unless it is right."""
    if not right:
        raise Finding(f"accepted: {what}")


def check_json(file: Path) -> Any:
    """The content of a file of JSON that pp-cl wrote. Raises Finding for NaN in it."""
    for line in file.read_text("utf-8").splitlines() if file.suffix == ".jsonl" else [None]:
        text = file.read_text("utf-8") if line is None else line
        content = json.loads(text, parse_constant=lambda name: check(False, f"{name} written"))
    return content if file.stat().st_size else None


def check_numbers(numbers: dict[str, Any], what: str) -> None:
    """Raise Finding unless all are finite."""
    for name, value in numbers.items():
        check(math.isfinite(value), f"{what}: {name} = {value}")
