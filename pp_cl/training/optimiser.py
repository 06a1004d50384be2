"""The update of everything learned: RMSprop of the SH coefficients, Adam of the rest, and the
averaged (EMA) copy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.device.rows import DeviceRows
from pp_cl.model import Model
from pp_cl.raster.project import ProjectedPoints
from pp_cl.settings import NetworkConfig, TrainConfig
from pp_cl.training.adam import Ema, adam_update
from pp_cl.training.point_state import PointState
from pp_cl.training.rmsprop import ShGradient, rmsprop_update
from pp_cl.training.schedule import learning_rate

OPACITY_EPS = 1e-15  # opacity gradients span many decades; clamping bounds the step instead
NETWORK_EPS = 1e-8  # PyTorch's default


@dataclass(frozen=True)
class Rates:
    """The learning rates of one step. sh: of the degrees 0, 1, 2."""

    sh: tuple[float, ...]
    opacity: float
    network: float

    @classmethod
    def at(cls, step: int, network: NetworkConfig, train: TrainConfig) -> Rates:
        """The rates of a step from 0 on."""
        steps = train.iterations
        sh = tuple(
            learning_rate(
                step, steps, first, first * train.sh_rate_decay, delay_steps=round(delay * steps)
            )
            if first
            else 0.0
            for first, delay in zip(train.sh_rate, train.sh_delay, strict=True)
        )
        # opacities travel about as far in a long training as in a short one
        scale = math.sqrt(min(1.0, train.opacity_rate_steps / steps or 1.0))
        return cls(
            sh,
            scale * learning_rate(step, steps, *train.opacity_rate),
            learning_rate(step, steps, *network.rate),
        )


class Optimiser:
    """Updates points and network; owns the network's moments and averages, the points' are in
    `state`.
    """

    def __init__(self, dev: Device, model: Model, state: PointState):
        self.dev = dev
        self.model = model
        self.state = state
        self.moments = {
            name: {kind: dev.zeros(array.shape) for kind in "mv"}
            for name, array in model.net.parameters.items()
        }
        self.ema = Ema(dev)

    @staticmethod
    def table(parameters: dict[str, Array], ema: bool) -> Table:
        """The arrays for these parameters of a network. ema: averages among them."""
        return {
            f"{kind}.{name}": (array.shape, np.float32)
            for name, array in parameters.items()
            for kind in (("m", "v", "ema") if ema else ("m", "v"))
        }

    def update(
        self,
        step: int,
        rates: Rates,
        grads: tuple[Array, Array],
        *,
        points: ProjectedPoints,
        shaded: Array,
        sh_eps: float,
    ) -> None:
        """One step.

        step: from 1. grads: (grad_point_features (N,16), grad_opacity (N)); the network's own lie
        in model.net.gradients. points: in the image that the gradients belong to. shaded: (S)
        uint32, those that make it up; no others have a gradient of their features. sh_eps: eps of
        the SH coefficients' step.
        """
        model, state = self.model, self.state
        cloud, (grad_point_features, grad_opacity) = model.cloud, grads
        gradient = ShGradient(points, shaded, grad_point_features)
        rmsprop_update(
            self.dev, step, gradient, cloud.sh, moment=state.sh_moment, rates=rates.sh, eps=sh_eps
        )
        adam_update(
            self.dev,
            cloud.opacity,
            grad_opacity,
            state.opacity_moments,
            step=step,
            rate=rates.opacity,
            eps=OPACITY_EPS,
            bounded=True,
        )
        self._update_network(step, rates.network)

    def _update_network(self, step, rate):
        net = self.model.net
        for name, parameter in net.parameters.items():
            grad, moments = net.gradients[name], self.moments[name]
            adam_update(self.dev, parameter, grad, moments, step=step, rate=rate, eps=NETWORK_EPS)

    def update_ema(self, weight: float) -> None:
        """Move the averages of points and network towards the present values by `weight`; a weight
        of 1 starts them there.
        """
        self.state.ema.update(self.model.cloud.learned(), weight)
        self.ema.update(self.model.net.parameters, weight)

    def apply_ema(self) -> None:
        """Make the averages, where there are any, the model's values."""
        self.state.ema.apply(self.model.cloud.learned())
        self.ema.apply(self.model.net.parameters)

    def arrays(self) -> dict[str, DeviceRows]:
        """{name in a checkpoint: array} of all but the model's own arrays."""
        network = {
            f"moment.{kind}.{name}": array
            for name, arrays in self.moments.items()
            for kind, array in arrays.items()
        }
        network |= {f"average.{name}": array for name, array in self.ema.arrays.items()}
        rows = {name: DeviceRows(self.dev, array) for name, array in network.items()}
        return self.state.arrays() | rows

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take the state, as written by arrays(), out of the arrays of a checkpoint."""
        self.state.restore(self.model.cloud, arrays)
        for name, moments in self.moments.items():
            for kind, array in moments.items():
                self.dev.write(array, arrays.pop(f"moment.{kind}.{name}"))
        parameters = self.model.net.parameters
        keys = {name: f"average.{name}" for name in parameters}
        self.ema.restore(
            parameters, {n: arrays.pop(key) for n, key in keys.items() if key in arrays}
        )
