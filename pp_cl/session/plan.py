"""The settings that a training decides itself: first by its hull, then by memory and minutes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pp_cl.config import AUTOMATIC
from pp_cl.engine.grid import Grid
from pp_cl.engine.render import is_supersampled
from pp_cl.engine.training.schedule import refinements
from pp_cl.engine.views import View
from pp_cl.scene.hull import Hull, spacing_pixels
from pp_cl.scene.verdict import Agreement
from pp_cl.settings import Config, TrainConfig

UNSET = (0.0, 0.0)  # train.refine_at
NEVER = (1.0, 1.0)  # train.refine_at if the grid is never refined
# bounds of an automatic raster.radius, in point spacings; within them it is one pixel. A smaller
# radius is no better if points lie farther apart
LEAST_RADIUS, MOST_RADIUS = 0.85, 1.15


@dataclass(frozen=True)
class Plan:
    """The settings that a training chooses or changes: refine_at, supersampled and view_opacity of
    TrainConfig, radius of RasterConfig, automatic of Config. Each decision makes a
    new plan; the engine follows its settings(), and config.json stores them.
    """

    refine_at: tuple[float, ...]
    supersampled: float
    view_opacity: str
    radius: float
    automatic: tuple[str, ...]

    @classmethod
    def given(cls, config: Config) -> "Plan":
        """The plan that these settings contain."""
        train = config.train
        steps = train.refine_at, train.supersampled, train.view_opacity
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
            refine_at=self.refine_at,
            supersampled=self.supersampled,
            view_opacity=self.view_opacity,
        )

    def for_grid(
        self, train: TrainConfig, grid: Grid, views: Sequence[View], progress: float = 0.0
    ) -> "Plan":
        """A plan whose radius, if automatic, is one pixel of the images, within bounds, after the
        refinements that are still to come. grid: as it is now. train: other settings for the
        schedules.
        """
        if "raster.radius" not in self.automatic:
            return self
        to_come = sum(progress < at for at in refinements(self.train(train)))
        spacing = spacing_pixels(grid, [view.camera for view in views]) / 2**to_come
        radius = round(min(max(1 / spacing, LEAST_RADIUS), MOST_RADIUS), 3)
        return replace(self, radius=radius)

    def with_one_sample(self) -> "Plan":
        """A plan without supersampling."""
        return replace(self, supersampled=0.0)

    def unrefined(self, shares: Sequence[float]) -> "Plan":
        """A plan without the refinements at these shares."""
        return replace(
            self, refine_at=tuple(1.0 if share in shares else share for share in self.refine_at)
        )
