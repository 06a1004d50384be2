"""Writes the curves of a training for TensorBoard, with the package tensorboardX."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

BESIDES = ("step", "seconds")  # numbers in a row of the log that are not curves


@contextmanager
def curves(folder: Path, step: int) -> Iterator[Callable[[int, dict[str, Any] | None], None]]:
    """A function that writes a step's row of the log, if there is one, into a folder for
    TensorBoard. step: the first step to write; rows of an interrupted training from there on are
    replaced.
    """
    from tensorboardX import SummaryWriter

    with SummaryWriter(str(folder), purge_step=step) as writer:

        def write(step: int, row: dict[str, Any] | None) -> None:
            for name, value in scalars(row or {}):
                writer.add_scalar(name, value, step)

        yield write


def scalars(row: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield (name, number) for each curve in a row of the log, such as rates/sh/0 for the first
    number of {"rates": {"sh": [...]}}.
    """
    for name, value in row.items():
        if isinstance(value, (tuple, list)):
            value = dict(enumerate(value))
        if isinstance(value, dict):
            yield from ((f"{name}/{inner}", number) for inner, number in scalars(value))
        elif isinstance(value, (int, float)) and name not in BESIDES:
            yield name, value
