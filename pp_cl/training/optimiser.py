"""The update of everything learned: Adam, and the averaged (EMA) copy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.device.rows import DeviceRows
from pp_cl.model import Model
from pp_cl.settings import NetworkConfig, TrainConfig
from pp_cl.training.adam import (
    Directions,
    Ema,
    PointAdam,
    PointsWithGradient,
    ShGradient,
    adam_update,
)
from pp_cl.training.point_state import PointState
from pp_cl.training.schedule import learning_rate

OPACITY_EPS = 1e-15  # opacity gradients span many decades; clamping bounds the step instead
NETWORK_EPS = 1e-8  # PyTorch's default


@dataclass(frozen=True)
class Rates:
    """Adam's rates at one step. sh: of the degrees 0, 1, 2."""

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

    moment_scale: of SH moments in 16 bits; None: in 32.
    """

    def __init__(self, dev: Device, model: Model, state: PointState, moment_scale: float | None):
        self.dev = dev
        self.model = model
        self.state = state
        self.point_adam = PointAdam(dev, moment_scale)
        self.with_gradient = PointsWithGradient(dev)
        self.moments = {
            name: {kind: dev.zeros(array.shape) for kind in "mv"}
            for name, array in model.net.parameters.items()
        }
        self.ema = Ema(dev)

    @staticmethod
    def table(n: int, parameters: dict[str, Array], settings: TrainConfig) -> Table:
        """The arrays for n points and these parameters of a network, averages included."""
        kinds = ("m", "v", "ema") if settings.ema else ("m", "v")
        table = {
            f"{kind}.{name}": (array.shape, np.float32)
            for name, array in parameters.items()
            for kind in kinds
        }
        if settings.lazy_adam:
            table |= PointAdam.table(n) | PointsWithGradient.table(n)
        return table

    def update(
        self,
        step: int,
        rates: Rates,
        grads: tuple[Array, Array],
        *,
        camera_buffer: Array,
        shaded: Array,
        sh_eps: float,
    ) -> None:
        """One Adam step.

        step: from 1. grads: (grad_point_features (N,16), grad_opacity (N)); the network's own lie
        in model.net.gradients. camera_buffer: (20), of the image the gradients belong to. shaded:
        (S) uint32, the points that make up that image; lazy Adam reads the gradients of no others.
        sh_eps: Adam's eps of the SH coefficients.
        """
        cloud, state, adam = self.model.cloud, self.state, self.point_adam
        grad_point_features, grad_opacity = grads
        if state.last_step is None:
            updated = adam.all_points(step, cloud.count)
        else:
            rows = self.with_gradient.rows(shaded, grad_point_features)
            updated = adam.listed_points(step, rows, state.last_step)

        gradient = ShGradient(self._directions(camera_buffer), grad_point_features)
        for block, sh, learned in self._learned_blocks(rates):
            adam.update_sh(updated, block, gradient, sh, **learned, eps=sh_eps)
        moments = state.moments("opacity")
        adam.update_opacity(
            step, grad_opacity, cloud.opacity, moments, rate=rates.opacity, eps=OPACITY_EPS
        )
        self._update_network(step, rates.network)

    def add_pending(
        self,
        step: int,
        rates: Rates,
        *,
        camera_buffer: Array,
        shaded: Array,
        point_features: Array,
        sh_eps: float,
    ) -> None:
        """Add to the features (N, 16) of the shaded points what lazy Adam has yet to move them by
        (the arguments: of update()); nothing where Adam is dense.
        """
        if self.state.last_step is None:
            return
        adam, directions = self.point_adam, self._directions(camera_buffer)
        listed = adam.listed_points(step, shaded, self.state.last_step, updating=False)
        for block, _, learned in self._learned_blocks(rates):
            adam.add_pending(listed, block, directions, point_features, **learned, eps=sh_eps)

    def _directions(self, camera_buffer):
        return Directions(self.model.grid_buffer, camera_buffer, self.model.cloud.ids)

    def _learned_blocks(self, rates):
        """(block, coefficients, {"moments", "rate"}) of the SH that this step learns; the moments
        of the others are not even read.
        """
        cloud = self.model.cloud
        for block, sh in zip(cloud.blocks, cloud.sh, strict=True):
            rate = rates.sh[block.degree]
            if rate > 0:
                yield block, sh, {"moments": self.state.moments(block.name), "rate": rate}

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
