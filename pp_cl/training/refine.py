"""A finer grid in the course of training: every point becomes eight of half the spacing."""

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.model import Model
from pp_cl.training.point_state import PointState


def refine(dev: Device, model: Model, state: PointState, *, composited: bool) -> None:
    """Refine the model's points with their training state.

    composited: opacities are those of alpha compositing, which are lowered so that the doubled
    number of points behind one another lets as much light through; else they are kept.
    """
    state.replace_by(dev, model.refine())
    if composited:
        split_opacity(dev, model.cloud.opacity)
        if "opacity" in state.ema.arrays:
            split_opacity(dev, state.ema.arrays["opacity"])


def split_opacity(dev: Device, opacity: Array) -> None:
    """Replace every opacity o in [0, 1], (N,) float32, by 1 - sqrt(1 - o), in place."""
    n = len(opacity)
    dev.program("training/refine").launch("split_opacity", n, n=n, opacity=opacity)
