"""What happens between two steps of a training, and at its end: a function for each event."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pyopencl.array import Array

from pp_cl.engine.training.exposure import decided_at
from pp_cl.engine.training.prune import (
    points_of_large_parts,
    points_that_views_show,
    points_to_keep,
)
from pp_cl.engine.training.schedule import (
    SMOOTHING_EVERY,
    Rates,
    ema_weight,
    growths,
    has_passed,
    supersampling_at,
)
from pp_cl.engine.training.smooth import Smoother
from pp_cl.engine.training.specular import SpecularFit, fit_steps
from pp_cl.engine.training.state import split_opacity

if TYPE_CHECKING:
    from pp_cl.engine.step import Trainer


def after_update(trainer: Trainer, rates: Rates, before: float) -> None:
    """Decide on exposure, smooth the SH coefficients, update the EMA, prune and refine, each if it
    is due after this step. before: the training's progress at its beginning.
    """
    step = trainer.step

    def passes(shares):
        return any(has_passed(share, before, trainer.progress) for share in shares)

    if trainer.make_room and passes(growths(trainer.config.train)):
        trainer.make_room(before)
    train = trainer.config.train
    for is_last in (False, True):
        due = step == decided_at(trainer.begun, len(trainer.views), is_last=is_last)
        if trainer.exposure and due:
            trainer.exposure.decide(is_last)
            if is_last and not trainer.exposure.is_applied:
                trainer.exposure = None
    if train.sh_smoothing > 0 and step % SMOOTHING_EVERY == 0:
        with trainer.dev.stage("smoothing"):
            smooth(trainer, rates)
    weight = ema_weight(before, trainer.progress) if train.ema else 0
    if weight > 0:
        with trainer.dev.stage("averages"):
            trainer.optimiser.update_ema(weight)
    is_judged = train.prune_weight > 0 and step % train.prune_every == 0
    if is_judged and trainer.progress < 1:
        with trainer.dev.stage("pruning"):
            prune(trainer)
    if passes(trainer.refine_at):
        with trainer.dev.stage("refining"):
            refine(trainer)


def smooth(trainer: Trainer, rates: Rates) -> None:
    """Pull every SH coefficient towards the mean of its grid neighbours."""
    train, cloud = trainer.config.train, trainer.model.cloud
    if trainer.smoother is None:
        trainer.smoother = Smoother(trainer.dev, trainer.model.grid_buffer, cloud.ids)
    pull = train.sh_smoothing * SMOOTHING_EVERY
    for block, sh in zip(cloud.blocks, cloud.sh, strict=True):
        if rates.sh[block.degree] > 0:
            trainer.smoother.smooth(sh, min(1.0, pull * rates.sh[block.degree]))


def prune(trainer: Trainer) -> None:
    """Drop the points that were in enough images and had too low a blend weight or opacity."""
    opacity, train = trainer.model.cloud.opacity, trainer.config.train
    keep(trainer, points_to_keep(trainer.dev, trainer.state, opacity, train))


def keep(trainer: Trainer, rows: Array) -> None:
    """Drop all points but `rows`, with their training state."""
    if len(rows) < trainer.model.cloud.count:
        trainer.smoother = None
        trainer.renderer.release()  # rows are moved through scratch memory
        trainer.model.cloud.compact(trainer.dev, rows)
        trainer.state.compact(trainer.dev, rows)


def refine(trainer: Trainer) -> None:
    """Densify: replace each point by eight at half the spacing, and double the images."""
    trainer.smoother = None
    trainer.renderer.release()
    trainer.state.refine(trainer.dev, trainer.model.refine())
    if trainer.composited:
        split_opacity(trainer.dev, trainer.model.cloud.opacity)
        if "opacity" in trainer.state.averages:
            split_opacity(trainer.dev, trainer.state.averages["opacity"])
    trainer.renew_crops()


def finish(trainer: Trainer) -> None:
    """End the training: take the EMA as parameters, and drop the points whose opacity is too low or
    that too few training views show, then small groups of points left in the air.
    """
    trainer.optimiser.apply_ema()
    if trainer.config.train.prune_weight > 0:
        trainer.renderer.release()  # makes room for whole views with weights by pair
        keep(trainer, points_that_views_show(trainer.renderer, trainer.views, trainer.config))
        keep(trainer, points_of_large_parts(trainer.model))
    if trainer.config.train.specular == "auto" and trainer.composited:
        fit_specular(trainer)


def fit_specular(trainer: Trainer) -> None:
    """Fit a specular layer, and keep it if it helps on views that it was not fitted to."""
    train = trainer.config.train
    trainer.renderer.supersampling = supersampling_at(trainer.progress, train)

    def target(index):
        return whole_target(trainer, index)

    fit = SpecularFit(trainer.renderer, trainer.views, target, trainer.gamma, train.seed)
    trainer.fitted = fit.fitted(fit_steps(trainer.step))
    trainer.model.specular = trainer.fitted.layer


def whole_target(trainer: Trainer, index: int) -> Array:
    """(h, w, 3) float32 on the device: the target for the image of a view, by index."""
    camera = trainer.views[index].camera
    image, alpha = trainer.targets.crop(trainer.views[index], (0, 0, camera.width, camera.height))
    if trainer.exposure and trainer.exposed:
        return trainer.exposure.target(index, image, alpha)
    return image
