"""How many steps a training has that is given minutes, by the time that its steps take."""

import math
import statistics
from collections import deque

from pp_cl.engine.training.schedule import refine_steps, supersampling_at
from pp_cl.settings import TrainConfig

NEVER = (1.0, 1.0)  # train.refine_at of a grid that is not refined
PLANS = 50  # in the minutes given
FIXED = 0.8  # share of the steps after which their number rises no more: soon the averages begin
FOG = 0.35  # of the first step's time, which later ones save: a third of the steps clears it
DEARER = 2.3  # times that a step takes longer once the grid is refined: 2 to 3 where measured
SUPERSAMPLED = 1.3  # times that a step takes longer once it is supersampled
# Steps of a training, for each of its refinements, below which it is better without any: in the
# time of 250 steps of `small`, lego has 27.4 dB with its refinement and 29.8 without, in that of
# 800 steps 31.5 and 32.3.
LEAST_REFINED = 1000
# Times as long as a step of halved images that one without a refinement takes: a guess, which the
# next plan corrects.
WHOLE = 1.5
# Of a step's time, for as many pixels of a training view, which the end looks at, and again for the
# specular layer; and seconds of that one's fit.
ENDING, LOOKING, FITTING = 0.15, 0.3, 4.0
FEWEST, MOST = 10, 100  # last steps whose median time counts: first ones may build kernels


class Budget:
    """Sets train.iterations so that the training takes train.minutes. pixels: of all its views.
    may_stay_coarse: the grid is left as it is where the steps are too few to refine it.
    """

    def __init__(self, train: TrainConfig, pixels: int, may_stay_coarse: bool = False):
        self._train, self._may_stay_coarse = train, may_stay_coarse
        is_fitted = train.specular == "auto"
        share = ENDING + LOOKING * is_fitted
        self._ending = share * pixels / train.crop**2 if train.crop else 0.0  # steps
        self._fitting = FITTING * is_fitted
        self._times: deque[float] = deque(maxlen=MOST)
        self._last = self._next = 0.0  # seconds: of the last step, and at which to plan

    def plan(self, step: int, seconds: float) -> bool:
        """Plan if that is due after a step, up to whose end so many seconds have passed, or not."""
        train = self._train
        self._times.append(seconds - self._last)
        self._last = seconds
        changes = supersampling_at(step, train) != supersampling_at(step - 1, train)
        if changes or step in refine_steps(train):
            self._times.clear()
        if len(self._times) < FEWEST or seconds < self._next:
            return False
        given = 60 * train.minutes / train.members
        self._next = seconds + given / PLANS
        left = given - seconds - self._fitting
        clearing = 1 - FOG * max(0.0, 1 - 3 * step / train.iterations)
        left /= clearing * statistics.median(self._times)
        replan(train, step, left, self._ending)
        to_come = refine_steps(train)
        is_coarse = self._may_stay_coarse and all(at > step for at in to_come)
        if is_coarse and train.iterations < LEAST_REFINED * len(to_come):
            train.refine_at = NEVER
            self._times.clear()  # of images of another size
            replan(train, step, left / WHOLE, self._ending)
        self._may_stay_coarse = False
        return True


def replan(train: TrainConfig, step: int, left: float, ending: float = 0.0) -> None:
    """Set train.iterations of a training that has time for `left` more steps without refinements,
    and train.refine_at and supersampled so that what is past stays where it was. ending: steps that
    its end is worth.
    """
    steps, shares = train.iterations, [share for share in train.refine_at if 0 < share < 1]
    is_late = step >= FIXED * steps
    past = {share: at for share in shares if (at := max(1, round(share * steps))) <= step}
    to_come = [at / steps for at in refine_steps(train) if at > step]
    dearer = [(share, DEARER) for share in to_come]
    begun, begins = supersampling_at(step, train) > 1, 1 - train.supersampled
    if not begun:
        dearer.append((begins, SUPERSAMPLED))
    all_as_one, start, cost = 0.0, 0.0, 1.0
    for end, times in [*sorted(dearer), (1.0, 1.0)]:
        all_as_one += (end - start) * cost
        start, cost = end, cost * times
    # is not jumped over
    soonest = min([1.0 if is_late else FIXED, *(share for share in shares if share not in past)])
    soonest = soonest if begun else min(soonest, begins)
    left -= ending * DEARER ** len(to_come)
    planned = max(round((step + left) / all_as_one), math.ceil((step + 1) / soonest))
    if is_late and planned > steps:  # else averages would begin anew
        return
    train.iterations = planned
    train.refine_at = tuple(past[s] / planned if s in past else s for s in train.refine_at)
    if begun:
        train.supersampled = 1 - begins * steps / planned
