"""The optimiser: RMSprop for the points, Adam for the network, and the exponential moving average
(EMA) of all parameters.

RMSprop is sparse: it touches only visible points with a gradient. cl/training/rmsprop.cl has its
formulas, docs/maths.md the reasons.
"""

from __future__ import annotations

import math

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, row_parts
from pp_cl.engine.layers.conv import PARTS_MACROS, GradientParts
from pp_cl.engine.model import Model
from pp_cl.engine.raster.blend import BlendGradients
from pp_cl.engine.raster.footprint import FOOTPRINTS
from pp_cl.engine.raster.points import PointCloud, four_blocks, stored_degree
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.training.schedule import Rates
from pp_cl.engine.training.state import PointState

BETA1, BETA2 = 0.9, 0.999  # Kingma & Ba 2015
DECAY1, DECAY2 = f"{1 - BETA1:.9g}f", f"{1 - BETA2:.9g}f"
POINT_EPS = 1e-15  # gradients of points span many decades; clamping bounds the step instead
NETWORK_EPS = 1e-8  # PyTorch's default


def network_state_table(n: int, is_averaged: bool) -> Table:
    """The arrays that the optimiser keeps for a network of n parameters: Adam's moments, and the
    averages once these are kept.
    """
    names = ("m", "v", "average") if is_averaged else ("m", "v")
    return dict.fromkeys(names, ((n,), np.float32))


class Optimiser:
    """Updates points and network; owns the network's moments and averages, the points' are in
    `state`.

    moments: Adam's {"m": array, "v": array} of all parameters of the network. averages: {"network":
    array} of them, empty before update_ema().
    """

    def __init__(self, dev: Device, model: Model, state: PointState):
        self.dev = dev
        self.model = model
        self.state = state
        table = network_state_table(model.net.all_parameters.size, is_averaged=False)
        self.moments = {kind: dev.zeros(*row) for kind, row in table.items()}
        self.averages: dict[str, Array] = {}

    def update(
        self,
        step: int,
        rates: Rates,
        gradients: BlendGradients,
        network_parts: GradientParts | None,
        *,
        points: ProjectedPoints,
        visible: Array,
        count: int,
        sh_eps: float,
    ) -> None:
        """Take one step along the gradients of the visible points and of the network.

        step: from 1. network_parts: None if the network has no parameters. points: as projected
        into the rendered view. visible: uint32, the indices of the S = count visible points.
        sh_eps: eps of the SH coefficients.
        """
        net = self.model.net
        rmsprop_update(
            self.dev,
            step,
            rates,
            gradients.visible_features,
            gradients.opacity,
            gradients.offset,
            points=points,
            visible=visible,
            count=count,
            cloud=self.model.cloud,
            state=self.state,
            sh_eps=sh_eps,
        )
        if network_parts:
            adam_update(
                self.dev,
                net.all_parameters,
                network_parts,
                self.moments,
                step=step,
                rate=rates.network,
                eps=NETWORK_EPS,
            )

    def update_ema(self, weight: float) -> None:
        """Update the EMA of points and network: average += weight * (parameter - average); the
        first call starts them as copies.
        """
        for averages, parameters in self._averaged():
            for name, parameter in parameters.items():
                if name in averages:
                    ema_update(self.dev, averages[name], parameter, weight)
                else:
                    averages[name] = self.dev.empty(parameter.shape)
                    self.dev.copy(averages[name], parameter)

    def apply_ema(self) -> None:
        """Copy the EMA, if there is one, into the model's parameters, and release it."""
        for averages, parameters in self._averaged():
            for name in list(averages):
                self.dev.copy(parameters[name], averages.pop(name))

    def _averaged(self):
        """[(averages, the parameters of the same names)] of the points and of the network."""
        learned = self.model.cloud.learned()
        return [
            (self.state.averages, {name: learned[name] for name in PointState.ema_table(0)}),
            (self.averages, {"network": self.model.net.all_parameters}),
        ]


def adam_update(
    dev: Device,
    parameter: Array,
    parts: GradientParts,
    moments: dict[str, Array],
    *,
    step: int,
    rate: float,
    eps: float,
) -> None:
    """One Adam step, in place, of all weights and biases that have a gradient in `parts`.

    parameter, moments "m" and "v": float32 arrays of one shape, laid out as Network.all_parameters;
    the moments start as zeros. step: from 1 on. Raises ValueError when the shapes differ.
    """
    _same_shape(parameter, *moments.values())
    # rate (m / c1) / (sqrt(v / c2) + eps) = (rate root / c1) m / (sqrt(v) + eps root)
    root = math.sqrt(1 - BETA2**step)
    decays = {"DECAY1": DECAY1, "DECAY2": DECAY2}
    dev.program("training/adam", LANES=lanes(dev), **decays, **PARTS_MACROS).launch(
        "adam_update",
        parts.n * row_parts(dev),
        n=parts.n,
        rows=len(parts.table),
        rate=rate * root / (1 - BETA1**step),
        eps=eps * root,
        table=parts.table,
        partial=parts.partial,
        parameter=parameter,
        m=moments["m"],
        v=moments["v"],
    )


def ema_update(dev: Device, ema: Array, parameter: Array, weight: float) -> None:
    """Move an EMA, in place: ema += weight * (parameter - ema).

    ema, parameter: float32 arrays of one shape, any. Raises ValueError when the shapes differ.
    """
    _same_shape(ema, parameter)
    n = parameter.size
    dev.program("training/ema", LANES=lanes(dev)).launch(
        "ema_update", -(-n // lanes(dev)), n=n, weight=weight, parameter=parameter, ema=ema
    )


def rmsprop_update(
    dev: Device,
    step: int,
    rates: Rates,
    grad_visible_features: Array,
    grad_opacity: Array,
    grad_offset: Array | None,
    *,
    points: ProjectedPoints,
    visible: Array,
    count: int,
    cloud: PointCloud,
    state: PointState,
    sh_eps: float,
) -> None:
    """One step of what the visible points learn, in place, by the gradients of their features (S,
    16), opacities (S,) and offsets (S, 4), of Gaussians (S, 16), each or longer; None: offsets
    stay. The gradient of a SH coefficient is the product of its harmonic in the direction from the
    eye to the point and the gradient of the point's feature; it is never formed.

    step: from 1 on. points, visible, count and sh_eps: as Optimiser.update() takes them.
    """
    degree = max((d for d in range(stored_degree(cloud.sh) + 1) if rates.sh[d] > 0), default=0)
    root, (sh_0, sh_1, sh_2a, sh_2b) = math.sqrt(1 - BETA2**step), four_blocks(cloud.sh)
    v, parts, kind = state.second_moments, row_parts(dev), cloud.kind
    program = dev.program(
        "training/rmsprop",
        LANES=lanes(dev),
        DEGREE=degree,
        DECAY2=DECAY2,
        LOG_BETA2=f"{math.log2(BETA2):.9g}f",
        MOVES_OFFSET=int(grad_offset is not None),
        MOST_OFFSET=f"{kind.most_offset}f",
        OFFSETS=kind.offsets,
        RECORD=FOOTPRINTS[points.footprint].record,
        **({"MOST_SH": f"{kind.most_sh}f"} if kind.most_sh < math.inf else {}),
    )
    fits = program.kernels["rmsprop_move"].largest_group >= parts
    program.launch(
        "rmsprop_move",
        count * parts,
        None if fits else parts,  # the device refuses: the parts of a point wait for each other
        s=count,
        step=step,
        eps=root * sh_eps,
        rate_0=root * rates.sh[0],
        rate_1=root * rates.sh[1],
        rate_2=root * rates.sh[2],
        point_eps=root * POINT_EPS,
        rate_offset=root * rates.offset,
        rate_opacity=root * rates.opacity,
        rate_lobe=root * rates.lobe,
        visible=visible,
        camera=points.camera_buffer,
        point_record=points.point_record,
        grad_visible_features=grad_visible_features,
        grad_offset=grad_offset,
        grad_opacity=grad_opacity,
        last_step=state.last_step,
        v=v["sh"],
        v_offset=v["offset"],
        v_opacity=v["opacity"],
        offset=cloud.offset,
        opacity=cloud.opacity,
        sh_0=sh_0,
        sh_1=sh_1,
        sh_2a=sh_2a,
        sh_2b=sh_2b,
    )


def _same_shape(first, *others):
    if any(array.shape != first.shape for array in others):
        raise ValueError(f"arrays of one shape wanted: {[a.shape for a in (first, *others)]}")
