"""Searches the smallest and fastest reduction of a model within a given loss of PSNR."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pp_cl.bench.timing import interleave
from pp_cl.compress.reduction import Original, Reduction, measured_psnr, nbytes
from pp_cl.errors import UserError
from pp_cl.run import Run, scene_is_there
from pp_cl.scene.load import scene_splits
from pp_cl.scene.views import View, evenly

# What is tried in turn: the share of the loss that all so far may take, and the field's values,
# from mild to harsh; the first that is too harsh ends it. What only makes rendering faster must do
# so.
TRIALS = (
    (0.2, "half", (True,)),
    (0.5, "channels", (0.001, 0.01, 0.03, 0.1)),
    (0.6, "early_stop", (0.01, 0.03, 0.1)),
    (0.6, "degree", (1, 0)),
)
SMALLER = ("half", "degree")  # these take memory as well
LEAST_KEPT = 5  # % of the points
FASTER = 0.98  # of the time, at most, counts as faster
TIMED_VIEWS, ROUNDS = 4, 9
MOST_VIEWS, HELD_EVERY = 16, 8  # of validation


@dataclass(frozen=True)
class Trial:
    """A reduction that was tried. psnr: of the validation views, dB; loss: against the original;
    nbytes: of the arrays; speed: frames per second over those of what was taken before, None where
    not timed.
    """

    what: str
    reduction: Reduction
    psnr: float
    loss: float
    nbytes: int
    points: int
    speed: float | None
    taken: bool


class Search:
    """Finds a reduction that loses at most `most_loss` dB over the validation views.

    error: mean square by which the views, where they are the original's own renderings, are wrong.
    psnr: of the original. reduction, run, loss: what was taken so far, and what it loses.
    """

    def __init__(self, original: Original, views: list[View], most_loss: float, error: float = 0.0):
        self.original, self.views, self.most_loss = original, views, most_loss
        self.reduction, self.run, self.loss = Reduction.of(original.run), original.run, 0.0
        self.error = error
        self.psnr = self._measured(original.run)

    def _measured(self, run):
        """PSNR against the photographs: errors of renderings and of what reduces them add up."""
        return -10 * float(np.log10(10 ** (-measured_psnr(run, self.views) / 10) + self.error))

    def trials(self) -> Iterator[Trial]:
        """What is tried, in turn; afterwards `reduction` is the one found."""
        for share, name, values in TRIALS:
            for value in values:
                if not self._is_harsher(name, value):
                    continue
                trial = self._try(f"{name} {value}", {name: value}, share)
                yield trial
                if not trial.taken:
                    break
        yield from self._prune()

    def _is_harsher(self, name, value):
        present = getattr(self.reduction, name)
        return value < present if name == "degree" else value > present

    def _try(self, what, changes, share=1.0):
        """Measure a change of the present reduction, and adopt it where it serves."""
        changed = replace(self.reduction, **changes)
        run = self.original.reduced(changed)
        psnr = self._measured(run)
        loss = self.psnr - psnr
        fits, speed = loss <= share * self.most_loss, None
        if fits and not {*changes} & {*SMALLER, "keep"}:
            present, new = frame_ms([self.run, run], self.views)
            fits, speed = new <= FASTER * present, present / new
        if fits:
            self.reduction, self.run, self.loss = changed, run, loss
        return Trial(what, changed, psnr, loss, nbytes(run), run.model.cloud.count, speed, fits)

    def _prune(self):
        """Halve the interval of the shares of points that may do."""
        fails, fits = LEAST_KEPT - 1, 100
        while fits - fails > 1:
            middle = (fails + fits) // 2
            trial = self._try(f"points {middle}%", {"keep": middle / 100})
            yield trial
            if trial.taken:
                fits = middle
            else:
                fails = middle


def validation_views(run: Run) -> tuple[str, list[View], float]:
    """(which they are, views, their error as Search has it) to measure a loss on, at most
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


def frame_ms(runs: list[Run], views: list[View]) -> list[float]:
    """Median milliseconds of a frame of each run, in turn over a few views."""
    cameras = [views[i * len(views) // TIMED_VIEWS].camera for i in range(TIMED_VIEWS)]

    def renderer(run):
        def render():
            for camera in cameras:
                run.renderer.render(camera, run.gamma)

        return render

    times = interleave({i: renderer(run) for i, run in enumerate(runs)}, rounds=ROUNDS)
    return [float(np.median(times[i])) / len(cameras) for i in range(len(runs))]
