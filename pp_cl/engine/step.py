"""One step of training: draw a crop of a view, render it, compute the loss and its gradients,
update. training/between.py has the work between steps, session/training.py the loop.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Pending
from pp_cl.engine.device.device import Device
from pp_cl.engine.model import Model
from pp_cl.engine.render import Renderer, RenderResult
from pp_cl.engine.training import between
from pp_cl.engine.training.crops import Crop, Crops
from pp_cl.engine.training.depth_loss import depth_gradient
from pp_cl.engine.training.exposure import Exposure
from pp_cl.engine.training.ignored import ignore_gradient, ignore_target
from pp_cl.engine.training.loss import Loss
from pp_cl.engine.training.optim import Optimiser
from pp_cl.engine.training.schedule import (
    Rates,
    gamma_at,
    late_weight,
    refinements,
    rising_weight,
    supersampling_at,
)
from pp_cl.engine.training.smooth import Smoother
from pp_cl.engine.training.specular import Fitted
from pp_cl.engine.training.state import PointState
from pp_cl.engine.training.target import Target
from pp_cl.engine.views import View
from pp_cl.settings import Config


class Trainer:
    """Optimises a model on views; every random choice is a function of (seed, step), so a run can
    start at any step.

    step: number of steps done. begun: the step at which the optimiser's moments started; above 0 if
    a finished training is extended. progress: of the steps done, as schedules take it. clock: tells
    it after each step, from the number of steps; None: by iterations. steps: how many there will be
    in all, for rates that depend on it. refine_at: the progresses at which the grid is refined,
    ascending. make_room: called, if set, with the progress before a step after which more memory is
    taken; it may follow() settings without that. state: the training state of each point. crops: an
    instance of the class given as `crops`, which draws them.
    """

    def __init__(
        self,
        dev: Device,
        config: Config,
        model: Model,
        views: list[View],
        crops: type[Crops] = Crops,
    ):
        train = config.train
        self.dev = dev
        self.config = config
        self.model = model
        self.model.specular = None  # fitted at the end
        self.views = views
        self.step = self.begun = 0
        self.renderer = Renderer(dev, model, config.raster)
        self.loss = Loss(dev, train.ssim_weight, train.smooth_l1, train.mask_weight)
        self.exposure: Exposure | None = None
        if train.exposure != "off":
            self.exposure = Exposure(dev, len(views), train.exposure == "on")
        self.state = PointState(dev, model.cloud)
        self.optimiser = Optimiser(dev, model, self.state)
        self.composited = config.raster.blend == "alpha"
        self.targets = Target(dev)
        self._buffers, self._depth_buffers = Buffers(dev), Buffers(dev)
        self._terms: Pending[dict[str, float]] | None = None  # of the last step's loss
        self.smoother: Smoother | None = None  # made when due, and again after points change
        self.progress = 0.0
        self.clock: Callable[[int], float] | None = None
        self.steps: float = train.iterations
        self.make_room: Callable[[float], None] | None = None
        self.refine_at = refinements(train)
        self._crops_class = crops
        self.renew_crops()
        self.fitted: Fitted | None = None  # set by finish()

    def follow(self, config: Config) -> None:
        """Go on with settings that differ in refine_at, supersampled and radius."""
        self.config = config
        self.renderer.settings = config.raster
        self.refine_at = refinements(config.train)
        if self.refinements_to_come != self.crops.halvings:
            self.renew_crops()

    def renew_crops(self) -> None:
        """Draw crops from now on of images halved as often as the grid will still be refined."""
        self.crops = self._crops_class(self.views, self.config.train, self.refinements_to_come)

    @property
    def refinements_to_come(self) -> int:
        """How often the grid will still be refined; the images are halved as often."""
        return sum(self.progress < at for at in self.refine_at)

    @property
    def exposed(self) -> str:
        """The exposure correction that is applied, as Exposure.kind names it."""
        return self.exposure.kind if self.exposure else ""

    @property
    def gamma(self) -> float:
        """Depth sharpness of the softmax after the steps done."""
        return gamma_at(self.progress)

    # ---- a step ----------------------------------------------------------------------------------

    def train_step(self) -> Pending[dict[str, float]]:
        """Enqueue one step, which the device may not have finished on return; returns the terms of
        its loss. Raises Diverged if a term of the previous step is not finite.
        """
        train = self.config.train
        rates = self.rates()
        crop = self.crops.draw(self.step)
        with self.dev.stage("target"):
            image, alpha = self.targets.crop(crop.view, crop.box, crop.jitter)
            target = image
            if self.exposure and self.exposure.is_applied:
                target = self.exposure.target(crop.view_index, image, alpha)
            says_nothing: np.ndarray | None = None
            if crop.view.ignored is not None:
                says_nothing = crop.view.ignored_crop(crop.box, crop.jitter)
            padded, *corner = crop.camera.padded(self.model.net.multiple)
            size = padded.height, padded.width
            gradient_tiles = self.model.net.gradient_tiles(target, says_nothing, size, corner)
            ignored = None if says_nothing is None else self._sent(says_nothing)

        self.renderer.supersampling = supersampling_at(self.progress, train)
        rendered = self.renderer.forward(
            crop.camera,
            self.gamma,
            training=True,
            gradient_tiles=gradient_tiles,
            times_seen=self.state.times_seen,
        )
        with self.dev.stage("loss"):
            if self.exposure:
                offset = rendered.offset
                self.exposure.fit(crop.view_index, rendered.image, image, alpha, offset)
            grad_image, grad_alpha = self._losses(crop, rendered, target, alpha, ignored)
            depth_weight = late_weight(self.progress, train.depth_weight)
            has_depth = self.composited and depth_weight > 0
            depth = self._depth_gradient(rendered, depth_weight) if has_depth else None
        # the distortion loss is a mean over the pixels, as a share of the grid's diagonal
        all_depths = alpha.size * rendered.supersampling**2 * self.model.grid.diagonal
        distortion_weight = self._rising(train.distortion_weight if self.composited else 0.0)
        gradients, network_parts = self.renderer.backward(
            rendered,
            grad_image,
            grad_alpha=grad_alpha,
            distortion_weight=distortion_weight / all_depths,
            depth_gradient=depth,
            with_offsets=rates.offset > 0,
            max_weight=self.state.max_weight,
        )

        with self.dev.stage("update"):
            self.optimiser.update(
                self.step + 1 - self.begun,
                rates,
                gradients,
                network_parts,
                points=rendered.points,
                visible=rendered.weights.visible_rows,
                count=rendered.weights.total,
                sh_eps=train.sh_eps / target.size,
            )
        self.step += 1
        before = self.progress
        self.progress = self.clock(self.step) if self.clock else self.step / train.iterations
        self.check()
        distortion = gradients.distortion, distortion_weight, 1 / all_depths
        self._terms = self.loss.read(self.step, *distortion)
        # so that the renderer can release them
        del rendered, gradients
        between.after_update(self, rates, before)
        return self._terms

    def _losses(
        self,
        crop: Crop,
        rendered: RenderResult,
        target: Array,
        alpha: Array,
        ignored: Array | None,
    ) -> tuple[Array, Array | None]:
        """(dL/dimage, dL/dalpha or None) of all terms but those of depths; self.loss keeps their
        values on the device. ignored: (H, W) uint8, 1 for ignored pixels of the crop.
        """
        image, offset = rendered.image, rendered.offset
        if ignored is not None:
            ignore_target(self.dev, ignored, image, target, alpha, offset)
        alphas, transmittance = None, rendered.transmittance  # None with a softmax
        has_mask = self.views[crop.view_index].has_mask  # cached here, not in crop.view
        if transmittance is not None and self.loss.mask_weight > 0 and has_mask:
            alphas = transmittance, alpha
        grad_image, grad_alpha = self.loss.forward_backward(
            image, target, *offset, alphas=alphas, shortfall=self._rising(1.0)
        )
        if ignored is not None:
            ignore_gradient(self.dev, ignored, grad_image, offset)
        return grad_image, grad_alpha

    def _depth_gradient(self, rendered, weight):
        """The gradient of weight times the depth loss, for Renderer.backward()."""
        view = rendered.points, rendered.weights, rendered.size
        of_loss = {"voxel_size": self.model.grid.voxel_size, "weight": weight}
        return depth_gradient(self.dev, self._depth_buffers, *view, **of_loss)

    def _sent(self, says_nothing):
        """The crop's ignored pixels on the device."""
        self._buffers.require({"ignored": (says_nothing.shape, np.uint8)})
        self.dev.send(self._buffers.ignored, says_nothing.astype(np.uint8))
        return self._buffers.ignored

    def _rising(self, weight):
        """A weight of the loss, scaled so that it rises from 0 during the training."""
        return rising_weight(self.progress, weight)

    def check(self) -> None:
        """Raise Diverged if a term of the loss of the last step is not finite."""
        if self._terms:
            self._terms.get()

    def finish(self) -> None:
        """End the training: take the EMA as parameters, drop points that training views do not
        show, and fit the specular layer.
        """
        between.finish(self)

    # ---- what the session shows and resumes ------------------------------------------------------

    def rates(self) -> Rates:
        """The learning rates of the next step."""
        return Rates.at(self.progress, self.steps, self.config.network, self.config.train)

    def render(self, view: View) -> np.ndarray:
        """(H, W, 3) float32 in [0, 1]: the current model's image of a view."""
        return self.renderer.render(view.camera, self.gamma)

    def target(self, view: View) -> np.ndarray:
        """(H, W, 3) float32 in [0, 1]: the image that render(view) should match."""
        return self.targets.whole(view)

    def start_at(self, step: int, begun: int, progress: float) -> None:
        """Go on after `step` steps at this progress; the optimiser's moments started at the step
        `begun`.
        """
        self.step, self.begun, self.progress = step, begun, progress
        self.renew_crops()
