"""Plans how many steps a training has in given minutes, from the time that its steps take."""

import statistics
from collections import deque

from pp_cl.engine.training.schedule import refine_steps, supersampling_at
from pp_cl.engine.training.specular import fit_steps
from pp_cl.session.plan import Plan
from pp_cl.settings import Config

PLANS = 50  # made in the given minutes
# share of the first step's time that later ones save: a third of the steps clears the fog
FOG = 0.35
# With fewer steps than this, a training is better without a refinement: in the time of 250 steps of
# `small`, lego reaches 27.4 dB with its refinement and 29.8 without; of 800 steps, 31.5 and 32.3;
# of 1,160 steps, 33.1 and 32.7.
FIRST_REFINED = 1000
# With fewer steps than this after the first refinement, it is better without the second: in 8
# minutes, 1,270 steps of `full`, lego reaches 31.6 dB with both and 33.5 with one; in 16 minutes,
# 3,000 steps, 34.4 and 35.0; in 28 minutes, 10,000 steps, 35.7 and 35.5: in between, both are equal
# at 7,500. The second is judged once the first is made: until then, images are small and steps
# cheap if it is to come.
FURTHER_REFINED = 7500
# A step without a refinement takes this many times as long as one on halved images: a guess, which
# the next plan corrects.
WHOLE = 1.5
# The end looks at all training views. For as many pixels as a step has, this takes ENDING of a
# step's time, and the specular layer adds LOOKING. FITTING: seconds of a step of that layer's fit,
# with its folds.
ENDING, LOOKING, FITTING = 0.15, 0.3, 1 / 150
FEWEST, MOST = 10, 100  # last steps whose median time counts: the first may build kernels


class Budget:
    """Plans the steps of a training that has train.minutes. pixels: of all its views.
    may_stay_coarse: whether refinements are left out that would have too few steps.
    """

    def __init__(self, config: Config, pixels: int, may_stay_coarse: bool = False):
        train, self._may_stay_coarse = config.train, may_stay_coarse
        is_fitted = train.specular == "auto"
        share = ENDING + LOOKING * is_fitted
        self._ending = share * pixels / train.crop**2 if train.crop else 0.0  # steps
        self._fitting = FITTING * is_fitted  # seconds a step
        self._times: deque[float] = deque(maxlen=MOST)
        self._last = self._next = 0.0  # seconds: end of the last step, time of the next plan

    def plan(self, config: Config, step: int, seconds: float) -> Plan | None:
        """A new plan, if one is due after this step; else None. seconds: how many have passed up to
        the step's end.
        """
        train = config.train
        self._times.append(seconds - self._last)
        self._last = seconds
        changes = supersampling_at(step, train) != supersampling_at(step - 1, train)
        if changes or step in refine_steps(train):
            self._times.clear()
        if len(self._times) < FEWEST or seconds < self._next:
            return None
        time_given = 60 * train.minutes / train.members
        self._next = seconds + time_given / PLANS
        time_left = time_given - seconds - self._fitting * fit_steps(train.iterations)
        clearing = 1 - FOG * max(0.0, 1 - 3 * step / train.iterations)
        time_left /= clearing * statistics.median(self._times)
        given, refined = Plan.given(config), refine_steps(train)
        to_come = sum(at > step for at in refined)
        if self._may_stay_coarse and to_come:
            since = max((at for at in refined if at <= step), default=0)
            left = time_left / WHOLE ** (to_come - 1)
            once = given.refined_at_most(1, step).for_minutes(train, step, left, self._ending)
            if once.iterations - since < (FURTHER_REFINED if since else FIRST_REFINED):
                self._times.clear()  # these were of images of another size
                time_left /= WHOLE
                given = given.refined_at_most(0, step)
        return given.for_minutes(train, step, time_left, self._ending)
