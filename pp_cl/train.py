"""The training loop: what one step does, in the order of the paper."""

import math

import numpy as np

from pp_cl.errors import UserError
from pp_cl.render import Renderer
from pp_cl.scene.target import Target
from pp_cl.training.adam import moment_scale
from pp_cl.training.loss import Loss
from pp_cl.training.optimiser import Optimiser, Rates
from pp_cl.training.prune import keep_indices, prune
from pp_cl.training.schedule import average_weight, gamma
from pp_cl.training.smooth import Smoother

BOX_MARGIN = 8  # pixels around the object from which crops are drawn


class Trainer:
    """Optimises a model on views; every random choice is a function of (seed, step), so a run can
    start at any step.
    """

    def __init__(self, dev, config, model, views):
        self.dev = dev
        self.config = config.train
        self.network = config.network
        self.gamma = config.raster.gamma
        self.model = model
        self.views = views
        self.step = 0
        self.renderer = Renderer(dev, model, config.raster)
        self.target = Target(dev)
        self.loss = Loss(dev, self.config.ssim_weight)
        self.optimiser = Optimiser(dev, model, self.config.lazy_adam, self._moment_scale())
        self.boxes = [view.object_bounds(BOX_MARGIN) for view in views]
        model.points["weight"] = dev.zeros((model.count,))
        self._smoother = None

    def _moment_scale(self):
        """Of moments in 16 bits, from the eps of the first view: powers of two, so that others may
        differ from it.
        """
        if not self.config.moments_16bit:
            return None
        camera = self.views[0].camera
        return moment_scale(
            self.config.sh_eps / (3 * math.prod(self.config.crop_size(camera.width, camera.height)))
        )

    # ----------------------------------------------------------------------------------------------

    def train_step(self):
        """One step; returns {"loss", "l1", "ssim", "psnr"} of its crop. Raises UserError if the
        loss is not finite.
        """
        t, config = self.step, self.config
        rng = np.random.default_rng((config.seed, t))
        rates = Rates.at(t, self.network, config)
        view_index, box, phase = self.draw(rng)

        view = self.views[view_index]
        camera = view.crop_camera(box, phase)
        self.target.load(view)
        target = self.target.crop(box, phase)

        rendered = self.renderer.forward(
            camera,
            gamma(t, config.iterations, *self.gamma),
            dropout=config.dropout,
            seed=int(rng.integers(2**32)),
            training=True,
            key=view_index if self.views_stay() else None,
        )
        grad_image = self.loss.forward_backward(rendered.image, target, *rendered.offset)
        grads = self.renderer.backward(rendered, grad_image)
        self.optimiser.update(
            t + 1,
            rates,
            grads,
            rendered.camera_buffer,
            config.sh_eps / target.size,
            rendered.shaded,
        )
        self.renderer.add_point_weights(rendered, self.model.points["weight"])

        self.step = t + 1
        self._regularise(rates)
        return self._terms()

    def views_stay(self):
        """Whether every step sees a view as the last one did: whole images without phases, all
        points.
        """
        config = self.config
        return (
            config.crop == 0
            and config.dropout == 0
            and not (config.pixel_jitter and self.views[0].downscale > 1)
        )

    def draw(self, rng):
        """(view index, (x0, y0, width, height), phase) of this step: views in a new random order
        every epoch.
        """
        config, n = self.config, len(self.views)
        epoch, place = divmod(self.step, n)
        index = int(np.random.default_rng((config.seed, epoch, n)).permutation(n)[place])
        view = self.views[index]
        camera = view.camera
        phases = view.downscale if config.pixel_jitter else 1
        phase = tuple(int(p) for p in rng.integers(phases, size=2))
        if config.crop == 0:
            return index, (0, 0, camera.width, camera.height), phase
        x0, y0, x1, y1 = self.boxes[index]
        width, height = config.crop_size(camera.width, camera.height)
        return (
            index,
            (
                _draw_start(rng, x0, x1, width, camera.width),
                _draw_start(rng, y0, y1, height, camera.height),
                width,
                height,
            ),
            phase,
        )

    def _terms(self):
        total, l1, dissimilarity, mse = (float(x) for x in self.loss.terms.get())
        if not math.isfinite(total):
            raise UserError(
                f"the loss is not finite at step {self.step}; the last checkpoint is kept: "
                "lower train.sh_rate or network.rate"
            )
        return {
            "loss": total,
            "l1": l1,
            "ssim": 1 - dissimilarity,
            "psnr": -10 * math.log10(max(mse, 1e-10)),
        }

    # ------------------------------------------------------------------------------- between the st

    def _regularise(self, rates):
        """Grid smoothing, averaging and pruning, where they are due after this step."""
        config, t = self.config, self.step
        if config.sh_smoothing > 0 and t % config.sh_smoothing_every == 0:
            self._smooth(rates)
        weight = average_weight(t, config.iterations) if config.ema else 0
        if weight > 0:
            self.optimiser.average(weight)
        if t % config.prune_every == 0 and t < config.iterations:
            self._prune(self.model.points["weight"], config.prune_weight * config.prune_every)
            self.dev.fill(self.model.points["weight"], 0)

    def _smooth(self, rates):
        """Pull every SH coefficient towards the mean of its grid neighbours, outside Adam."""
        points = self.model.points
        if self._smoother is None:
            self._smoother = Smoother(self.dev, self.model.grid_buffer, points["ids"])
        pull = self.config.sh_smoothing * self.config.sh_smoothing_every
        for block in self.model.blocks:
            if rates.sh[block.degree] > 0:
                self._smoother.smooth(points[block.name], pull * rates.sh[block.degree])

    def _prune(self, weights, least):
        """Drop the points whose weight, or opacity, is too low; moments and averages go with
        them.
        """
        points = self.model.points
        keep = keep_indices(self.dev, weights, least, points["opacity"], self.config.prune_opacity)
        if len(keep) < self.model.count:
            self.renderer.cache.clear()
            prune(self.dev, points, keep)
            self._smoother = None

    def finish(self):
        """Adopt the averages, and drop the points that hardly weigh anything in any training
        view.
        """
        self.optimiser.adopt_averages()
        if self.config.final_prune_weight > 0:
            total = self.dev.zeros((self.model.count,))
            for view in self.views:
                weights = self.renderer.weigh(view.camera, self.gamma[1])
                self.renderer.add_point_weights(weights, total)
            self._prune(total, self.config.final_prune_weight)
        self.model.points = {name: self.model.points[name] for name in ("ids", *self.model.keys)}

    def rates(self):
        """The learning rates of the last step, for the log."""
        return vars(Rates.at(max(self.step - 1, 0), self.network, self.config))

    def picture(self, view):
        """(H,W,3) float32 in [0, 1]: the present model's picture of a view."""
        return self.renderer.render(
            view.camera,
            gamma(self.step, self.config.iterations, *self.gamma),
        )

    def truth(self, view):
        """(H,W,3) float32 in [0, 1]: what the picture should be."""
        self.target.load(view)
        return self.target.whole()

    def arrays(self):
        """{name: numpy array} of the whole state."""
        return self.model.arrays() | self.optimiser.arrays()

    def restore(self, step, arrays):
        """Go on after `step` steps with the arrays of a checkpoint; the model has been loaded
        already.
        """
        self.step = step
        self.optimiser.restore(arrays)


def _draw_start(rng, low, high, size, limit):
    """First pixel of a crop of `size` that shows a part of [low, high) as large as possible, inside
    [0, limit).
    """
    first, last = sorted((low, high - size))
    first, last = max(first, 0), min(last, limit - size)
    return int(rng.integers(min(first, last), max(first, last) + 1))
