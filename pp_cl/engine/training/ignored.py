"""Pixels of a target that say nothing: they have no loss and no gradient."""

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.training.loss import corner_of


def ignore_target(
    dev: Device,
    ignored: Array,
    prediction: Array,
    target: Array,
    target_alpha: Array,
    offset: tuple[int, int],
) -> None:
    """Make a target (H, W, 3) what the prediction (PH, PW, 3) is, and target_alpha (H, W) -1, where
    a pixel is ignored.

    ignored: (H, W) uint8, 1 where it is. offset: (left, top) of the target in the prediction.
    """
    height, width = ignored.shape
    dev.program("training/ignored").launch(
        "ignore_target",
        (width, height),
        w=width,
        h=height,
        pw=prediction.shape[1],
        corner=corner_of(prediction.shape, target.shape, *offset),
        ignored=ignored,
        prediction=prediction,
        target=target,
        target_alpha=target_alpha,
    )


def ignore_gradient(
    dev: Device, ignored: Array, grad_prediction: Array, offset: tuple[int, int]
) -> None:
    """Make dL/dprediction (PH, PW, 3) 0 where a pixel is ignored; as ignore_target() takes it."""
    height, width = ignored.shape
    dev.program("training/ignored").launch(
        "ignore_gradient",
        (width, height),
        w=width,
        h=height,
        pw=grad_prediction.shape[1],
        corner=corner_of(grad_prediction.shape, (height, width, 3), *offset),
        ignored=ignored,
        grad_prediction=grad_prediction,
    )
