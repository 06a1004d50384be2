"""The settings that a training decides itself: first by its hull, then by memory and minutes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pp_cl.config import AUTOMATIC
from pp_cl.engine.grid import Grid
from pp_cl.engine.render import is_supersampled
from pp_cl.engine.training.schedule import refine_steps, supersampling_at
from pp_cl.engine.views import View
from pp_cl.scene.hull import Hull, spacing_pixels
from pp_cl.scene.verdict import Agreement
from pp_cl.settings import Config, TrainConfig

UNSET = (0.0, 0.0)  # train.refine_at
NEVER = (1.0, 1.0)  # train.refine_at if the grid is never refined
# bounds of an automatic raster.radius, in point spacings; within them it is one pixel. A smaller
# radius is no better if points lie farther apart
LEAST_RADIUS, MOST_RADIUS = 0.85, 1.15
FIXED = 0.8  # share of the steps after which their number no longer rises: averages begin soon
DEARER = 2.3  # factor by which a refinement of the grid lengthens a step: measured 2 to 3
SUPERSAMPLED = 1.3  # factor by which supersampling lengthens a step


@dataclass(frozen=True)
class Plan:
    """The settings that a training chooses or changes: iterations, refine_at, supersampled and
    view_opacity of TrainConfig, radius of RasterConfig, automatic of Config. Each decision makes a
    new plan; the engine follows its settings(), and config.json stores them.
    """

    iterations: int
    refine_at: tuple[float, ...]
    supersampled: float
    view_opacity: str
    radius: float
    automatic: tuple[str, ...]

    @classmethod
    def given(cls, config: Config) -> "Plan":
        """The plan that these settings contain."""
        train = config.train
        steps = train.iterations, train.refine_at, train.supersampled, train.view_opacity
        return cls(*steps, config.raster.radius, tuple(config.automatic))

    @classmethod
    def of(
        cls, config: Config, hull: Hull, agreement: Agreement, refine_at: tuple[float, ...]
    ) -> "Plan":
        """The plan that a training begins with, in which automatic settings have values. refine_at:
        as first_hull() returns it with the hull.
        """
        given = cls.given(config)
        is_open = given.refine_at == UNSET, given.radius == 0, given.view_opacity == "auto"
        automatic = tuple(key for key, is_auto in zip(AUTOMATIC, is_open, strict=True) if is_auto)
        plan = replace(given, refine_at=refine_at, automatic=automatic)
        if not is_supersampled(config.raster):
            plan = plan.with_one_sample()
        if "train.view_opacity" in automatic:
            plan = replace(plan, view_opacity="off" if agreement.forgiven else "on")
        return plan.for_grid(config.train, hull.grid, agreement.views)

    def settings(self, config: Config) -> Config:
        """A copy of the settings with this plan's values."""
        raster, train = replace(config.raster, radius=self.radius), self.train(config.train)
        return replace(config, automatic=[*self.automatic], raster=raster, train=train)

    def train(self, train: TrainConfig) -> TrainConfig:
        """The TrainConfig of settings(), which schedules take."""
        return replace(
            train,
            iterations=self.iterations,
            refine_at=self.refine_at,
            supersampled=self.supersampled,
            view_opacity=self.view_opacity,
        )

    def for_grid(
        self, train: TrainConfig, grid: Grid, views: Sequence[View], step: int = 0
    ) -> "Plan":
        """A plan whose radius, if automatic, is one pixel of the images, within bounds, after the
        refinements planned after `step`. grid: as it is now. train: other settings for the
        schedules.
        """
        if "raster.radius" not in self.automatic:
            return self
        to_come = sum(step < at for at in refine_steps(self.train(train)))
        spacing = spacing_pixels(grid, [view.camera for view in views]) / 2**to_come
        radius = round(min(max(1 / spacing, LEAST_RADIUS), MOST_RADIUS), 3)
        return replace(self, radius=radius)

    def with_one_sample(self) -> "Plan":
        """A plan without supersampling."""
        return replace(self, supersampled=0.0)

    def refined_at_most(self, most: int, step: int) -> "Plan":
        """A plan with at most `most` refinements after `step`, the first ones of this plan."""
        planned = sorted(share for share in self.refine_at if share < 1)
        dropped = [share for share in planned if share * self.iterations > step + 0.5][most:]
        return replace(
            self, refine_at=tuple(1.0 if share in dropped else share for share in self.refine_at)
        )

    def for_minutes(
        self, train: TrainConfig, step: int, left: float, ending: float = 0.0
    ) -> "Plan":
        """A plan whose iterations take the time of `left` more steps after `step`, if none of these
        were refined. refine_at and supersampled change so that past events keep their steps. train:
        other settings for the schedules. ending: the time that the end takes, in steps that are
        not supersampled.
        """
        train = self.train(train)
        steps, shares = self.iterations, [share for share in self.refine_at if 0 < share < 1]
        is_late = step >= FIXED * steps
        past = {share: at for share in shares if (at := max(1, round(share * steps))) <= step}
        to_come = [at / steps for at in refine_steps(train) if at > step]
        dearer = [(share, DEARER) for share in to_come]
        begun, begins = supersampling_at(step, train) > 1, 1 - self.supersampled
        if not begun:
            dearer.append((begins, SUPERSAMPLED))
        all_as_one, start, cost = 0.0, 0.0, 1.0
        for end, times in [*sorted(dearer), (1.0, 1.0)]:
            all_as_one += (end - start) * cost
            start, cost = end, cost * times
        # no event is skipped: the first of these must lie after this step
        soonest = [1.0 if is_late else FIXED, *(share for share in shares if share not in past)]
        soonest += [] if begun else [begins]
        left -= ending * DEARER ** len(to_come) / (SUPERSAMPLED if begun else 1)
        planned = max(round((step + left) / all_as_one), math.ceil((step + 1) / min(soonest)))
        if is_late and planned > steps:  # more steps would begin the averages anew
            return self
        return replace(
            self,
            iterations=planned,
            refine_at=tuple(past[s] / planned if s in past else s for s in self.refine_at),
            supersampled=1 - begins * steps / planned if begun else self.supersampled,
        )
