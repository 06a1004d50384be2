"""Gains of images that differ in exposure or white balance, and whether they do."""

import warnings

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import launch_groups
from pp_cl.engine.training.loss import corner_of

DECAY = 0.7  # of a view's sums from one of its steps to the next
PRIOR = 1e-3  # squares per pixel: black objects tell no gains
# steps on each view, and in all, after which it is known whether images differ: before,
# gains explain much of what a small model has not learned yet
LOOKS, LEAST_STEPS = 2, 100
LEAST_SHARE = 0.25  # of the squared error that gains must explain
TINY = 1e-12


class Exposure:
    """A gain for each view and channel, relative to the views' mean, found while a training runs.

    state: (views, 3, 4) float32, of each channel the sums of rendering times image, of the
    rendering squared and of the image squared, and the gain. is_applied: whether images are divided
    by their gains, or these only look on.
    """

    def __init__(self, dev: Device, views: int, is_applied: bool):
        self.dev = dev
        self.is_applied = is_applied
        self.state = dev.upload(np.tile([0, 0, 0, 1], (views, 3, 1)), np.float32)
        self._buffers = Buffers(dev)

    def target(self, view: int, image: Array, alpha: Array) -> Array:
        """(H, W, 3) float32: an image divided by its view's gains, valid until the next call.

        view: its index. image: (H, W, 3) float32, over white. alpha: (H, W) float32.
        """
        height, width = alpha.shape
        self._buffers.require({"target": ((height, width, 3), np.float32)})
        self.dev.program("training/exposure").launch(
            "exposure_divide",
            height * width,
            hw=height * width,
            view=view,
            exposure=self.state,
            image=image,
            alpha=alpha,
            target=self._buffers.target,
        )
        return self._buffers.target

    def fit(
        self,
        view: int,
        prediction: Array,
        image: Array,
        alpha: Array,
        offset: tuple[int, int],
    ) -> None:
        """Learn from an image as target() takes it and the prediction (PH, PW, 3), on which it
        lies at offset = (left, top).
        """
        (height, width), b = alpha.shape, self._buffers
        b.require({"row_products": ((3, height, 4), np.float32)})
        launch_groups(
            self.dev,
            "training/exposure",
            "exposure_products",
            height,
            h=height,
            w=width,
            pw=prediction.shape[1],
            corner=corner_of(prediction.shape, image.shape, *offset),
            prediction=prediction,
            image=image,
            alpha=alpha,
            row_products=b.row_products,
        )
        self.dev.program("training/exposure").launch(
            "exposure_fit",
            3,
            views=len(self.state),
            view=view,
            h=height,
            decay=DECAY,
            prior=PRIOR * height * width,
            row_products=b.row_products,
            exposure=self.state,
        )

    def explained(self) -> float:
        """The share of the last steps' squared error after the best gain of each channel that the
        views' own gains explain; 0 where there is none.
        """
        pt, pp, tt, _ = np.moveaxis(self.dev.download(self.state).astype(np.float64), -1, 0)
        common = (tt.sum(0) - pt.sum(0) ** 2 / np.maximum(pp.sum(0), TINY)).sum()
        own = (tt - pt**2 / np.maximum(pp, TINY)).sum()
        return float(1 - own / common) if common > TINY else 0.0

    def decided(self) -> "Exposure | None":
        """Itself, applied from now on, if gains explain enough of the error, else None."""
        share = self.explained()
        if share <= LEAST_SHARE:
            return None
        self.is_applied = True
        warnings.warn(
            f"the images differ in exposure or white balance ({share:.0%} of their error);"
            " a gain of each view and channel is found beside the model (train.exposure)",
            stacklevel=2,
        )
        return self


def decided_at(begun: int, views: int) -> int:
    """The step after which it is known whether the images of a training differ. begun: the step at
    which its moments started.
    """
    return begun + max(LOOKS * views, LEAST_STEPS)
