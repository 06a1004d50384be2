"""Adam for everything learned, and the averaged (EMA) copy of it.

The moments and averages of the points lie beside them in model.points, so that pruning moves all
rows alike.
"""

from dataclasses import dataclass

import numpy as np

from pp_cl.training.adam import PointAdam, Touched, adam_update, ema_update
from pp_cl.training.schedule import learning_rate

OPACITY_EPS = 1e-15  # opacity gradients span many decades; clamping bounds the step instead
NETWORK_EPS = 1e-8  # PyTorch's default


@dataclass(frozen=True)
class Rates:
    """Adam's rates at one step. sh: of the degrees 0, 1, 2."""

    sh: tuple
    opacity: float
    network: float

    @classmethod
    def at(cls, step, network, train):
        """The rates of a step from 0 on. network, train: config.NetworkConfig,
        config.TrainConfig.
        """
        steps = train.iterations
        sh = tuple(
            learning_rate(step, steps, first, first * train.sh_rate_decay, round(delay * steps))
            if first
            else 0.0
            for first, delay in zip(train.sh_rate, train.sh_delay, strict=True)
        )
        return cls(
            sh,
            learning_rate(step, steps, *train.opacity_rate),
            learning_rate(step, steps, *network.rate),
        )


class Optimiser:
    """Moments of the points and the network, and their updates.

    lazy: a step updates only the points that received a gradient; else all of them. scale: see
    PointAdam.
    """

    def __init__(self, dev, model, lazy=False, scale=None):
        self.dev = dev
        self.model = model
        self.lazy = lazy
        self.moments = {
            f"{kind}.{name}": dev.zeros(array.shape)
            for name, array in model.net.parameters.items()
            for kind in "mv"
        }
        self.point_adam, self.touched = PointAdam(dev, lazy, scale), Touched(dev)
        for block in model.blocks:
            for kind, array in self.point_adam.sh_moments(block, model.count).items():
                model.points[f"{kind}.{block.name}"] = array
        for kind in "mv":
            model.points[f"{kind}.opacity"] = dev.zeros((model.count,))
        if lazy:
            model.points["last"] = dev.zeros((model.count,), np.uint32)
        self.averages = {}  # of the network; those of the points are model.points["a.*"]

    def update(self, step, rates, grads, camera, feature_eps, kept):
        """One Adam step.

        step: from 1. grads: (grad_point_features (N,16), grad_opacity (N)); the network's own
        gradients lie in it. camera: (20) device buffer of the view. feature_eps: Adam's eps of the
        SH coefficients. kept: (S) uint32, the points of the picture; a lazy update reads the
        gradients of no others.
        """
        grad_features, grad_opacity = grads
        points, adam = self.model.points, self.point_adam
        if self.lazy:
            adam.begin_lazy(step, self.touched.rows(kept, *grads), points["last"])
        else:
            adam.begin(step, self.model.count)
        for block in self.model.blocks:
            if rates.sh[block.degree] == 0:
                continue  # its moments are not even read
            adam.update_sh(
                block,
                self.model.grid_buffer,
                camera,
                points["ids"],
                grad_features,
                points[block.name],
                {kind: points[f"{kind}.{block.name}"] for kind in adam.kinds},
                rates.sh[block.degree],
                feature_eps,
            )
        opacity = [points[name] for name in ("opacity", "m.opacity", "v.opacity")]
        adam.update_opacity(grad_opacity, *opacity, rates.opacity, OPACITY_EPS)
        for name, parameter in self.model.net.parameters.items():
            adam_update(
                self.dev,
                parameter,
                self.model.net.gradients[name],
                self.moments[f"m.{name}"],
                self.moments[f"v.{name}"],
                step,
                rates.network,
                NETWORK_EPS,
            )

    def average(self, weight):
        """Move the averages towards the present values by `weight`; a weight of 1 starts them
        there.
        """
        for parameter, store, key in self._averaged():
            if key not in store:
                store[key] = self.dev.empty(parameter.shape)
            ema_update(self.dev, store[key], parameter, weight)

    def adopt_averages(self):
        """Make the averages, where there are any, the model's values."""
        for parameter, store, key in self._averaged():
            if key in store:
                self.dev.copy(parameter, store.pop(key))

    def _averaged(self):
        points = self.model.points
        for name in self.model.keys:
            yield points[name], points, f"a.{name}"
        for name, parameter in self.model.net.parameters.items():
            yield parameter, self.averages, name

    def arrays(self):
        """{name: numpy array} of the state beside the model's own arrays."""
        own = {f"moment.{name}": a.get() for name, a in self.moments.items()}
        own |= {f"average.{name}": a.get() for name, a in self.averages.items()}
        learned = {"ids", *self.model.keys}
        return own | {
            f"state.{name}": a.get() for name, a in self.model.points.items() if name not in learned
        }

    def restore(self, arrays):
        """Take the state of a checkpoint, as written by arrays(). Raises KeyError and ValueError
        for what does not fit.
        """
        for name in self.moments:
            self.moments[name].set(arrays[f"moment.{name}"])
        points = self.model.points
        for name in [n for n in points if n not in ("ids", *self.model.keys)]:
            if arrays[f"state.{name}"].shape != points[name].shape:
                raise ValueError(f"state.{name} has shape {arrays[f'state.{name}'].shape}")
            points[name].set(arrays[f"state.{name}"])
        for parameter, store, key in list(self._averaged()):
            name = f"state.{key}" if store is points else f"average.{key}"
            if name in arrays:
                store[key] = self.dev.upload(arrays[name].reshape(parameter.shape))
