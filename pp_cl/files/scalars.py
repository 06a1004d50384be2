"""Writes the curves of a training for TensorBoard, with the package tensorboardX."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pp_cl.errors import UserError

BESIDES = ("step", "seconds")  # numbers of a row of the log that are no curves


def writer_class() -> type:
    """What writes for TensorBoard. Raises UserError where tensorboardX is missing."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise UserError(
            "--tensorboard: needs tensorboardX; install it with `pip install tensorboardX`"
        ) from None
    return SummaryWriter


class Scalars:
    """Writes the rows of a log into a folder that TensorBoard reads; the folder is made when the
    first row comes.

    step: from which on rows will be written, anew where an interrupted training wrote them before.
    Raises UserError where tensorboardX is missing.
    """

    def __init__(self, folder: Path, step: int) -> None:
        make = writer_class()
        self._make = lambda: make(str(folder), purge_step=step)
        self._writer: Any = None

    def __enter__(self) -> "Scalars":
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer:
            self._writer.close()

    def __call__(self, step: int, row: dict[str, Any] | None) -> None:
        """Write the row of a step, if there is one."""
        if row:
            self._writer = self._writer or self._make()
            for name, value in scalars(row):
                self._writer.add_scalar(name, value, step)


def scalars(row: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """(name, number) of each curve in a row of the log: of {"rates": {"sh": (0.5, 0.1)}} rates/sh/0
    and rates/sh/1.
    """
    for name, value in row.items():
        if isinstance(value, (tuple, list)):
            value = dict(enumerate(value))
        if isinstance(value, dict):
            yield from ((f"{name}/{inner}", number) for inner, number in scalars(value))
        elif isinstance(value, (int, float)) and name not in BESIDES:
            yield name, value
