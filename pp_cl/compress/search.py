"""Searches the smallest reduction of a model within a given loss of PSNR."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pp_cl.compress.reduction import Original, measured_psnr, nbytes
from pp_cl.errors import UserError
from pp_cl.run import Run, scene_is_there
from pp_cl.scene.load import scene_splits
from pp_cl.scene.views import View, evenly

OF_HALF = 0.2  # share of the loss that coefficients of 16 bits may take
LEAST_KEPT = 5  # % of the points
MOST_VIEWS, HELD_EVERY = 16, 8  # of validation


@dataclass(frozen=True)
class Trial:
    """A reduction that was tried: keep and half as Original.reduced() takes them. psnr: of the
    validation views, dB; loss: against the original; nbytes: of the arrays; taken: whether it loses
    little enough.
    """

    keep: float
    half: bool
    psnr: float
    loss: float
    nbytes: int
    points: int
    taken: bool

    def __str__(self) -> str:
        return f"{self.keep:.0%} of the points, {16 if self.half else 32} bits"


def search(
    original: Original, views: list[View], most_loss: float, error: float = 0.0
) -> Iterator[Trial]:
    """What is tried for a reduction that loses at most `most_loss` dB over the validation views:
    the original itself, coefficients of 16 bits, then shares of the points, halving the interval of
    those that may do. The last that is taken is the smallest.

    error: mean square by which the views, where they are the original's own renderings, are wrong;
    it and the errors of what reduces them add up.
    """

    def tried(run, keep, half, most_loss):
        psnr = -10 * float(np.log10(10 ** (-measured_psnr(run, views) / 10) + error))
        loss, count = (0.0 if run is original.run else whole.psnr - psnr), run.model.cloud.count
        return Trial(keep, half, psnr, loss, nbytes(run), count, taken=loss <= most_loss)

    half = original.run.model.cloud.sh[0].dtype == np.float16  # it is a compressed run
    yield (whole := tried(original.run, 1.0, half, most_loss))
    if not half:
        yield (trial := tried(original.reduced(1.0, True), 1.0, True, OF_HALF * most_loss))
        half = trial.taken
    fails, fits = LEAST_KEPT - 1, 100
    while fits - fails > 1:
        percent = (fits + fails) // 2
        keep = percent / 100
        yield (trial := tried(original.reduced(keep, half), keep, half, most_loss))
        fails, fits = (fails, percent) if trial.taken else (percent, fits)


def validation_views(run: Run) -> tuple[str, list[View], float]:
    """(which they are, views, their error as search() takes it) to measure a loss on, at most
    MOST_VIEWS: those of the split val, where the scene has none every eighth of the training views;
    where the scene is missing, the run's renderings of these. Never those of a test. Raises
    UserError where the scene is broken.
    """
    path = run.config.scene.path
    if not scene_is_there(path):
        psnr = _known_psnr(run)
        shown = evenly(run.photographs("train")[::HELD_EVERY], MOST_VIEWS)
        views = run.rendered(shown, opaque=True)
        which = f"{len(views)} renderings of train, taken to have {psnr:.2f} dB ({path} is missing)"
        return which, views, 10 ** (-psnr / 10)
    split = "val" if "val" in scene_splits(path) else "train"
    views = run.scene(split).splits[split]
    views = evenly(views[::HELD_EVERY] if split == "train" else views, MOST_VIEWS)
    return f"{len(views)} views of {split}", views, 0.0


def _known_psnr(run):
    """Of the run against photographs, as its last evaluation or else the log of its training
    says.
    """
    measured = run.folder.measured()
    if measured and "psnr" in measured["mean"] and measured["step"] == run.header["step"]:
        return measured["mean"]["psnr"]
    for row in reversed(run.folder.rows()):
        if "psnr" in row:
            return row["psnr"]
    raise UserError(
        f"{run.config.scene.path}: the run's scene is not there, and {run.folder} keeps no PSNR;"
        " say where the scene is with --scene"
    )
