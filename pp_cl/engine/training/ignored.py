"""Ignored pixels of a target: they contribute no loss and no gradient."""

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
    """At ignored pixels, copy the prediction (PH, PW, 3) to the target (H, W, 3), and set
    target_alpha (H, W) to -1.

    ignored: (H, W) uint8, 1 for ignored pixels. offset: (left, top) of the target in the
    prediction.
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
    """Set dL/dprediction (PH, PW, 3) to 0 at ignored pixels. Arguments as for ignore_target()."""
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
