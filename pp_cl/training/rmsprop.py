"""The step of the SH coefficients: RMSprop, one second moment for all coefficients of a feature.

A point without a gradient does not move, so a step touches only what its image shows. cl/training/
rmsprop.cl has the formulas, docs/maths.md the reasons.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, row_parts
from pp_cl.raster.project import ProjectedPoints
from pp_cl.raster.sh import sh_arguments, stored_degree
from pp_cl.training.adam import BETA2


@dataclass(frozen=True)
class ShGradient:
    """The gradient of the SH coefficients in one view, as the factors of a rank-one product: the
    harmonics of the directions from the eye to the points, and the gradient of their features.

    points: where they are in the view. shaded: (S) uint32, those that it shows.
    grad_point_features: (N, 16).
    """

    points: ProjectedPoints
    shaded: Array
    grad_point_features: Array


class SecondMoment(NamedTuple):
    """v: (N, 16) float32, of each feature. last_step: (N,) uint32, of each point's last gradient,
    0: none. Both start as zeros.
    """

    v: Array
    last_step: Array


def rmsprop_update(
    dev: Device,
    step: int,
    gradient: ShGradient,
    sh: Sequence[Array],
    *,
    moment: SecondMoment,
    rates: Sequence[float],
    eps: float,
) -> None:
    """One step of the coefficients of all points with a gradient, in place; of the gradient, which
    is overwritten, only the shaded rows are read.

    step: from 1 on. sh: arrays (N, count, 16) of SH_BLOCKS up to the end of one degree. rates: of
    the degrees 0, 1, 2. eps: of the gradient's unit.
    """
    degree = max((d for d in range(stored_degree(len(sh)) + 1) if rates[d] > 0), default=None)
    if degree is None:
        return
    shaded, grads, points = gradient.shaded, gradient.grad_point_features, gradient.points
    root = math.sqrt(1 - BETA2**step)
    decay = {"DECAY2": f"{1 - BETA2:.9g}f", "LOG_BETA2": f"{math.log2(BETA2):.9g}f"}
    program = dev.program("training/rmsprop", LANES=lanes(dev), DEGREE=degree, **decay)
    program.launch(
        "rmsprop_scale",
        len(shaded),
        s=len(shaded),
        step=step,
        eps=root * eps,
        shaded=shaded,
        grad_point_features=grads,
        **moment._asdict(),
    )
    program.launch(
        "rmsprop_move",
        len(shaded) * row_parts(dev),
        s=len(shaded),
        shaded=shaded,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        scaled_grads=grads,
        **{f"rate_{d}": root * rate for d, rate in enumerate(rates)},
        **sh_arguments(sh),
    )
