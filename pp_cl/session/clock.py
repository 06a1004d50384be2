"""The clock of a training that has train.minutes: its progress is the time that has passed."""

import statistics
from collections import deque
from collections.abc import Callable

from pp_cl.engine.training.specular import MOST_VIEWS, fit_steps
from pp_cl.settings import TrainConfig

# Steps that build nearly all kernels, or begin with arrays of another size: they tell nothing about
# the others, and the schedules do not move on in their time.
BUILDING = 2
FEWEST, RECENT = 10, 100  # steps of a training at least; last steps whose median time counts
RESERVED = 0.08  # share of the minutes for what follows the last step, until it is measured
MEASURED_AT = 0.8  # progress at which it is
# What follows looks at all views: once without a network, which takes LOOKING of an image's time,
# and for the specular layer at most MOST_VIEWS as a whole; a step of that layer's fit with its
# folds takes FITTING seconds.
LOOKING, FITTING = 0.5, 1 / 150


def seconds_after(train: TrainConfig, views: int, image: float, steps: float) -> float:
    """The seconds of what follows the last step. image: those of rendering a view."""
    is_fitted = train.specular == "auto"
    fit = FITTING * fit_steps(round(steps)) if is_fitted else 0.0
    looks = LOOKING * views * (train.prune_weight > 0) + min(views, MOST_VIEWS) * is_fitted
    return looks * image + fit


class Clock:
    """Call it after each step. passed: tells the seconds of `seconds` that have passed, as given to
    the training. progress: the last one. steps: how many there will be in all, as it seems.
    """

    def __init__(
        self, seconds: float, passed: Callable[[], float], progress: float, steps: float
    ) -> None:
        self._seconds, self._passed = seconds, passed
        self._times: deque[float] = deque(maxlen=RECENT)
        self._last, self._skipped = passed(), BUILDING
        self._ending = RESERVED * seconds
        self.progress, self.steps = progress, steps

    @property
    def _left(self):
        """Seconds left for steps."""
        return self._seconds - self._ending - self._last

    def reserve(self, seconds: float) -> None:
        """Set the time of what follows the last step."""
        self._ending = seconds

    def begins_anew(self) -> None:
        """Say that steps take another time from now on."""
        self._times.clear()
        self._skipped = BUILDING

    @property
    def steps_left(self) -> float:
        """How many steps are left if they take as long as the last ones."""
        return self._left / max(statistics.median(self._times or [0.0]), 1e-9)

    def __call__(self, step: int) -> float:
        """The progress after this many steps."""
        left, now = self._left, self._passed()
        took, self._last = now - self._last, now
        if self._skipped:
            self._skipped -= 1
            return self.progress
        self._times.append(took)
        if left > took:
            self.progress += (1 - self.progress) * took / left
        else:
            self.progress = 1.0
        self.steps = step + max(1.0, self.steps_left)
        if step < FEWEST:  # however little time there is, every schedule is passed
            self.progress = min(self.progress, step / FEWEST)
        return self.progress
