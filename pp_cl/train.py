"""One step of training: draw a crop of a view, render it, loss, backward, optimiser; then
smoothing, EMA, pruning and refining where they are due. session.py has the loop around it.
"""

import warnings

import numpy as np

from pp_cl.config import Config
from pp_cl.device.buffers import DeviceRows, Reading
from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.layers.tiles import tiles_find
from pp_cl.model import Model
from pp_cl.network.tile_plan import gradient_tiles
from pp_cl.raster.weights import record_weights
from pp_cl.render import NETWORK_MULTIPLE, Renderer
from pp_cl.scene.target import Target
from pp_cl.scene.views import View
from pp_cl.training.exposure import LEAST_SHARE, Exposure, decided_at
from pp_cl.training.loss import Loss, MaskLoss, ignore_gradient, ignore_target
from pp_cl.training.optim import Optimiser
from pp_cl.training.schedule import (
    BOX_MARGIN,
    Rates,
    crop_side,
    draw_start,
    ema_start,
    ema_weight,
    gamma_at,
    refine_steps,
    rising_weight,
)
from pp_cl.training.smooth import Smoother
from pp_cl.training.state import PointState, final_points_to_keep, points_to_keep, split_opacity

MANY_VIEWS = 24  # so many show every place several times
SPECK = 50  # points: a patch of about 7 x 7 pixels where they are a pixel apart
WHITE = 1.0  # of a target where its photograph is transparent


class Trainer:
    """Optimises a model on views; every random choice is a function of (seed, step), so a run can
    start at any step.

    step: number of steps done. begun: the step at which the optimiser's moments started; above 0
    if a finished training is extended. state: what training keeps for each point.
    """

    def __init__(self, dev: Device, config: Config, model: Model, views: list[View]):
        self.dev = dev
        self.config = config.train
        self.network = config.network
        self.gamma = config.raster.gamma
        self._composited = config.raster.blend == "alpha"
        self.model = model
        self.views = views
        self.step = self.begun = 0
        self.renderer = Renderer(dev, model, config.raster)
        self.loss = Loss(dev, self.config.ssim_weight, self.config.smooth_l1)
        self.mask_loss = MaskLoss(dev, self.config.mask_weight)
        self.exposure: Exposure | None = None
        if self.config.exposure != "off":
            self.exposure = Exposure(dev, len(views), self.config.exposure == "on")
        self.state = PointState(dev, model.cloud)
        self.optimiser = Optimiser(dev, model, self.state)
        self._target = Target(dev)
        self._terms: Reading[dict[str, float]] | None = None  # of the loss of the last step
        self._smoother = None  # made when it is due, anew when the points change
        self._refine_steps = refine_steps(self.config)
        self._set_level()

    @property
    def refinements_to_come(self) -> int:
        """How often the grid will still be refined."""
        return sum(self.step < step for step in self._refine_steps)

    @property
    def is_exposed(self) -> bool:
        """Whether photographs are divided by gains."""
        return self.exposure is not None and self.exposure.is_applied

    @property
    def network_size(self) -> tuple[int, int]:
        """(height, width) of the network's image for a crop of the first view."""
        view = self._reduced[0]
        camera = view.crop_camera((0, 0, *view.crop_size(self._crop)))
        padded, _, _ = camera.padded(NETWORK_MULTIPLE)
        return padded.height, padded.width

    def take_plan(self) -> None:
        """Take up another number of steps, in which there may be room for other refinements."""
        before = self.refinements_to_come
        self._refine_steps = refine_steps(self.config)
        if self.refinements_to_come != before:
            self._set_level()

    def _set_level(self):
        """Set images, crop size and object boxes for the present level of the grid: the images are
        halved once for every refinement still to come.
        """
        to_come = self.refinements_to_come
        self._reduced = _halved(self.views, to_come)
        self._crop = crop_side(self.config.crop, to_come)
        self._boxes = [view.object_bounds(BOX_MARGIN) for view in self._reduced]

    # ----------------------------------------------------------------------------------------------

    def train_step(self) -> Reading[dict[str, float]]:
        """Enqueue one step, which the device may not have finished on return; returns the terms of
        its loss. Raises Diverged if a term of the previous step is not finite.
        """
        t, config = self.step, self.config
        rng = np.random.default_rng((config.seed, t))
        rates = Rates.at(t, self.network, config)
        view_index, box, jitter = self.draw(rng)

        view = self._reduced[view_index]
        camera = view.crop_camera(box, jitter)
        with self.dev.stage("target"):
            photograph, target_alpha = self._target.crop(view, box, jitter)
            target = photograph
            if self.exposure and self.exposure.is_applied:
                target = self.exposure.target(view_index, photograph, target_alpha)
            tiles_of_gradient = self._gradient_tiles(target, camera)
            ignored = view.ignored_crop(box, jitter)

        rendered = self.renderer.forward(
            camera,
            gamma_at(t, config.iterations, *self.gamma),
            dropout=config.dropout,
            seed=int(rng.integers(2**32)),
            training=True,
            gradient_tiles=tiles_of_gradient,
        )
        with self.dev.stage("loss"):
            mask = target_alpha if view.has_mask else None
            if self.exposure:
                self.exposure.fit(
                    view_index, rendered.image, photograph, target_alpha, rendered.offset
                )
            if ignored is not None:
                ignored = self.dev.upload(ignored, np.uint8)
                ignore_target(
                    self.dev, ignored, rendered.image, target, target_alpha, rendered.offset
                )
            grad_image, grad_alpha = self._losses(rendered, target, mask)
            if ignored is not None:
                ignore_gradient(self.dev, ignored, grad_image, rendered.offset)
        spread_weight, all_depths = self._spread_weight(target)
        features, opacities, offsets, pixel_spread = self.renderer.backward(
            rendered,
            grad_image,
            grad_alpha=grad_alpha,
            spread_weight=spread_weight / all_depths,
            with_offsets=rates.offset > 0,
        )
        if spread_weight > 0:
            self.loss.add("spread", pixel_spread, spread_weight, 1 / all_depths)
        with self.dev.stage("update"):
            self.optimiser.update(
                t + 1 - self.begun,
                rates,
                features,
                opacities,
                offsets,
                points=rendered.points,
                shaded=rendered.weights.shaded,
                sh_eps=config.sh_eps / target.size,
            )
        with self.dev.stage("max weights"):
            record_weights(
                self.dev,
                rendered.pairs,
                rendered.weights,
                self.state.max_weight,
                self.state.times_seen,
            )

        self.step = t + 1
        self.check()
        self._terms = self.loss.read(self.step)
        # the renderer may release them now
        del rendered, features, opacities, offsets, pixel_spread
        self._after_update(rates)
        return self._terms

    def _losses(self, rendered, target, target_alpha):
        """(dL/dimage, dL/dalpha or None) of all terms but the spread.

        The value of the loss and of its terms goes to self.loss, which stays on the device.
        """
        config, loss, steps = self.config, self.loss, self.config.iterations
        image, weights, offset = rendered.image, rendered.weights, rendered.offset
        pixels = target.shape[0] * target.shape[1]
        grad_alpha = None

        grad_image = loss.forward_backward(image, target, *offset)
        if self._composited and config.mask_weight > 0 and target_alpha is not None:
            squares, grad_alpha = self.mask_loss.forward_backward(
                weights.transmittance,
                target_alpha,
                size=image.shape[:2],
                offset=offset,
                shortfall=rising_weight(self.step, steps),
            )
            loss.add("mask", squares, config.mask_weight, 1 / pixels)
        return grad_image, grad_alpha

    def _spread_weight(self, target):
        """(weight of the spread in the loss, what the sum over the pixels is divided by: their
        number times the diagonal of the grid).
        """
        weight = self.config.spread_weight if self._composited else 0.0
        pixels = target.shape[0] * target.shape[1]
        all_depths = pixels * self.model.grid.diagonal
        return rising_weight(self.step, self.config.iterations, weight), all_depths

    def draw(
        self, rng: np.random.Generator
    ) -> tuple[int, tuple[int, int, int, int], tuple[int, int]]:
        """(view index, (x0, y0, width, height), jitter) of this step: views in a new random order
        every epoch. jitter: stored pixels by which the reduced image starts further right and down.
        """
        config, n = self.config, len(self.views)
        epoch, place = divmod(self.step, n)
        index = int(np.random.default_rng((config.seed, epoch, n)).permutation(n)[place])
        view = self._reduced[index]
        camera = view.camera
        offsets = view.downscale if config.pixel_jitter else 1
        across, down = rng.integers(offsets, size=2)
        jitter = int(across), int(down)
        if self._crop == 0:
            return index, (0, 0, camera.width, camera.height), jitter
        x0, y0, x1, y1 = self._boxes[index]
        width, height = view.crop_size(self._crop)
        left = draw_start(rng, x0, x1, width, limit=camera.width)
        top = draw_start(rng, y0, y1, height, limit=camera.height)
        return index, (left, top, width, height), jitter

    def check(self) -> None:
        """Raise Diverged if a term of the loss of the last step is not finite."""
        if self._terms:
            self._terms.get()

    def _gradient_tiles(self, target, camera):
        """A function that returns gradient_tiles of UNet.plan_tiles(); called once the device has
        been waited for anyway, so that looking at the target costs no wait of its own.
        """
        padded, *offset = camera.padded(NETWORK_MULTIPLE)
        size = padded.height, padded.width
        if not self.model.net.is_planned(size):
            return lambda: None
        found = tiles_find(self.dev, target, WHITE)
        return lambda: gradient_tiles(found.get(), size, offset)

    # ----------------------------------------------------------------------------------------------

    def _after_update(self, rates):
        """Smooth the SH coefficients, update the EMA, prune and refine, each if due after this
        step.
        """
        config, t = self.config, self.step
        if self.exposure and t == decided_at(self.begun, len(self.views)) and not self.is_exposed:
            self._decide_exposure()
        if config.sh_smoothing > 0 and t % config.sh_smoothing_every == 0:
            with self.dev.stage("smoothing"):
                self._smooth(rates)
        weight = ema_weight(t, config.iterations) if config.ema else 0
        if weight > 0:
            with self.dev.stage("averages"):
                self.optimiser.update_ema(weight)
        if t % config.prune_every == 0 and t < config.iterations:
            with self.dev.stage("pruning"):
                self.prune()
        if t in self._refine_steps:
            self._refine()

    def _decide_exposure(self):
        """Apply the gains from now on, or forget them."""
        share = self.exposure.explained()
        if share > LEAST_SHARE:
            self.exposure.is_applied = True
            warnings.warn(
                f"the photographs differ in exposure or white balance ({share:.0%} of their error);"
                " a gain of each view and channel is found beside the model (train.exposure)",
                stacklevel=2,
            )
        else:
            self.exposure = None

    def _smooth(self, rates):
        """Pull every SH coefficient towards the mean of its grid neighbours."""
        cloud = self.model.cloud
        if self._smoother is None:
            self._smoother = Smoother(self.dev, self.model.grid_buffer, cloud.ids)
        pull = self.config.sh_smoothing * self.config.sh_smoothing_every
        for block, sh in zip(cloud.blocks, cloud.sh, strict=True):
            if rates.sh[block.degree] > 0:
                self._smoother.smooth(sh, min(1.0, pull * rates.sh[block.degree]))

    def prune(self) -> None:
        """Drop the points that were in enough images and had too low a blend weight or opacity."""
        self._keep(points_to_keep(self.dev, self.state, self.model.cloud.opacity, self.config))

    def _keep(self, rows):
        """Drop all points but `rows`, with their training state."""
        if len(rows) < self.model.cloud.count:
            self._smoother = None
            self.renderer.release()  # rows are moved through scratch memory
            self.model.cloud.compact(self.dev, rows)
            self.state.compact(self.dev, rows)

    def _refine(self):
        """Densify: replace each point by eight at half the spacing, and double the images."""
        self._smoother = None
        self.renderer.release()
        with self.dev.stage("refining"):
            self.state.refine(self.dev, self.model.refine())
            if self._composited:
                split_opacity(self.dev, self.model.cloud.opacity)
                if "opacity" in self.state.averages:
                    split_opacity(self.dev, self.state.averages["opacity"])
        self._set_level()

    def finish(self) -> None:
        """End the training: take the EMA as parameters, and drop the points whose opacity is too
        low or that too few training views show, and those that then hang in the air by few.
        """
        self.optimiser.apply_ema()
        if self.config.final_prune_weight > 0:
            self.renderer.release()  # for whole views with weights by pair
            self._prune_unseen()
            self._prune_specks()

    def _prune_unseen(self):
        """Drop the points that reach train.final_prune_weight in no training view; where there are
        many views, in all but one: what a single photograph shows is mostly a speck in others.
        """
        cloud, least_weight = self.model.cloud, self.config.final_prune_weight
        max_weight, seen = (self.dev.zeros((cloud.count,)) for _ in range(2))
        for view in self.views:
            drawn = self.renderer.forward(view.camera, self.gamma[1], until="weights")
            record_weights(self.dev, drawn.pairs, drawn.weights, max_weight, seen, least_weight)
            del drawn  # else its arrays would stay beside the larger ones of the next view
        least = 2 if len(self.views) >= MANY_VIEWS else 1
        opacity = cloud.opacity
        self._keep(final_points_to_keep(self.dev, max_weight, seen, opacity, self.config, least))

    def _prune_specks(self):
        """Drop the points of parts that are too small to be of the object."""
        is_kept = self.model.grid.in_large_parts(self.dev.download(self.model.cloud.ids), SPECK)
        self._keep(self.dev.upload(np.flatnonzero(is_kept), np.uint32))

    def rates(self) -> dict:
        """The learning rates of the last step, for the log."""
        return vars(Rates.at(max(self.step - 1, 0), self.network, self.config))

    def render(self, view: View) -> np.ndarray:
        """(H, W, 3) float32 in [0, 1]: the present model's image of a view."""
        gamma = gamma_at(self.step, self.config.iterations, *self.gamma)
        return self.renderer.render(view.camera, gamma)

    def target(self, view: View) -> np.ndarray:
        """(H, W, 3) float32 in [0, 1]: what render(view) should be."""
        return self._target.whole(view)

    def arrays(self) -> dict[str, DeviceRows]:
        """{name in a checkpoint: array} of the model and of the training's state. Raises UserError
        as check().
        """
        self.check()
        exposure = {"exposure": DeviceRows(self.dev, self.exposure.state)} if self.exposure else {}
        return self.model.arrays() | self.optimiser.arrays() | exposure

    def restore(self, step: int, arrays: dict[str, np.ndarray], begun: int) -> None:
        """Resume after `step` steps with the training state of a checkpoint, which is taken out of
        `arrays`; the model has been loaded already. A finished training stores no such state: its
        moments start anew, and its EMA if that is due.
        """
        self.step, self.begun = step, begun
        self._set_level()
        if arrays:
            self.optimiser.restore(arrays)
            if "exposure" not in arrays:
                self.exposure = None
            elif self.exposure:
                self.dev.write(self.exposure.state, arrays.pop("exposure"))
                self.exposure.is_applied |= step >= decided_at(begun, len(self.views))
        elif self.config.ema and step >= ema_start(self.config.iterations):
            self.optimiser.update_ema(1.0)


def _halved(views, times):
    """The views at 1 / 2^times of their size. Raises UserError where that is too small."""
    try:
        return [view.reduced(view.downscale * 2**times) for view in views]
    except UserError as error:
        raise UserError(
            f"train.refine_at halves the images {times} times; use fewer of them ({error})"
        ) from None
