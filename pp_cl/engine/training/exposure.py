"""Finds out whether images differ in exposure, white balance or colour, and compensates for it."""

import warnings

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import launch_groups
from pp_cl.engine.training.loss import corner_of

DECAY = 0.7  # multiplies the sums of a view whenever a step sees it
PRIOR = 1e-3  # weight per pixel of the identity, which black objects keep
# The steps on each view, and the least in all, after which gains are decided on; matrices are LATER
# times as late. Any earlier, they explain much of what the small model has not learned yet.
LOOKS, LEAST_STEPS, LATER = 2, 100, 4
LEAST_SHARE = 0.25  # of the squared error, which gains must explain to be applied
# The same for matrices, and their least share of the error that gains leave. Matrices explain .02
# to .18 of the error of images as cameras made them, .40 if each has a random matrix within 15 %.
LEAST_FULL_SHARE, LEAST_BEYOND = 0.28, 0.11
TINY = 1e-12
GAINS, MATRICES = "gains", "matrices"
HALF, MATRIX = 8, 16  # rows of a view's sums of one half of its image; the first row of its matrix


class Exposure:
    """A colour matrix for each view, relative to the mean of all views, estimated during a
    training.

    state: (views, 19, 4) float32. For each half of a view's images 8 rows of sums of products:
    (rendering, alpha) with (rendering, alpha), 4 rows; image with (rendering, alpha), 3 rows; the
    image squared. Then the matrix, 3 rows. is_applied: the targets are corrected by the matrices;
    if False, these are only estimated. is_full: the matrices are more than a gain per channel.
    """

    def __init__(self, dev: Device, views: int, is_applied: bool):
        self.dev = dev
        self.is_applied, self.is_full = is_applied, False
        state = np.zeros((views, MATRIX + 3, 4), np.float32)
        state[:, MATRIX:] = np.eye(3, 4)
        self.state = dev.upload(state)
        self._buffers = Buffers(dev)

    def target(self, view: int, image: Array, alpha: Array) -> Array:
        """(H, W, 3) float32: an image in the colours of the model, valid until the next call.

        view: its index. image: (H, W, 3) float32, over white. alpha: (H, W) float32.
        """
        height, width = alpha.shape
        self._buffers.require({"target": ((height, width, 3), np.float32)})
        self.dev.program("training/exposure_undo").launch(
            "exposure_undo",
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
        """Update the estimate by an image, as target() takes it, and the prediction (PH, PW, 3), on
        which the image lies at offset = (left, top).
        """
        (height, width), b, views = alpha.shape, self._buffers, len(self.state)
        b.require({"row_products": ((height, MATRIX, 4), np.float32)})
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
        program, exposure = self.dev.program("training/exposure"), self.state
        program.launch(
            "exposure_sum",
            MATRIX,
            view=view,
            h=height,
            decay=DECAY,
            row_products=b.row_products,
            exposure=exposure,
        )
        prior = PRIOR * height * width
        program.launch(
            "exposure_solve",
            views,
            views=views,
            is_full=self.is_full,
            prior=prior,
            exposure=exposure,
        )
        program.launch("exposure_centre", 1, views=views, exposure=exposure)

    def explained(self) -> tuple[float, ...]:
        """Three shares of squared errors of the last steps: of the error that one gain per channel,
        common to all views, leaves, the shares that gains and that matrices of each view explain;
        and of the error that such gains leave, the share that matrices explain. The last two are
        fitted to one half of each image and measured on the other. 0 if there is no error.
        """
        sums = self.dev.download(self.state)[:, :MATRIX].astype(np.float64)
        halves = sums.reshape(-1, 2, HALF, 4)
        views = halves.sum(1)
        common = _remaining(views.sum(0), _gains(views.sum(0)))
        if common <= TINY:
            return 0.0, 0.0, 0.0
        own = sum(_remaining(view, _gains(view)) for view in views)
        gains, matrices = (
            sum(_remaining(a, best(b)) + _remaining(b, best(a)) for a, b in halves)
            for best in (_gains, _matrix)
        )
        shares = own / common, matrices / common, matrices / max(gains, TINY)
        return tuple(1 - float(share) for share in shares)

    def decide(self, is_last: bool) -> None:
        """Apply gains or matrices from now on, if they explain enough of the error. is_last: late
        enough in the training to judge matrices, too.
        """
        by_gains, by_matrices, beyond = self.explained()
        if is_last:
            self.is_full = by_matrices > LEAST_FULL_SHARE and beyond > LEAST_BEYOND
        if is_last and self.is_full:
            reason = f"colour ({by_matrices:.0%} of their error); a matrix for each view is"
        elif not self.is_applied and by_gains > LEAST_SHARE:
            reason = (
                f"exposure or white balance ({by_gains:.0%} of their error); a gain for each view"
                " and channel is"
            )
        else:
            return
        self.is_applied = True
        message = f"the images differ in {reason} learned with the model (train.exposure)"
        warnings.warn(message, stacklevel=2)

    @property
    def kind(self) -> str:
        """The correction that is applied, as a checkpoint names it: GAINS, MATRICES or ""."""
        if not self.is_applied:
            return ""
        return MATRICES if self.is_full else GAINS

    def restore(self, kind: str, state: np.ndarray | None = None) -> None:
        """Continue with a checkpoint's kind of correction; without its state, estimate it anew."""
        if state is not None:
            self.dev.write(self.state, state)
        self.is_applied, self.is_full = self.is_applied or bool(kind), kind == MATRICES


def _gains(sums):
    """(3, 4) matrix of the best gain of each channel, from sums (HALF, 4)."""
    gains = [sums[4 + c, c] / max(sums[c, c], TINY) for c in range(3)]
    return np.diag([*gains, 0.0])[:3]


def _matrix(sums):
    """(3, 4) best matrix, from sums (HALF, 4)."""
    prior = PRIOR * np.trace(sums[:4]) + TINY
    return np.linalg.solve(sums[:4] + prior * np.eye(4), (sums[4:7] + prior * np.eye(3, 4)).T).T


def _remaining(sums, matrix):
    """The squared error that a matrix (3, 4) leaves, from sums (HALF, 4)."""
    crossed = 2 * (matrix * sums[4:7]).sum()
    return sums[7, :3].sum() - crossed + np.trace(matrix @ sums[:4] @ matrix.T)


def decided_at(begun: int, views: int, *, is_last: bool = True) -> int:
    """The step after which a training decides on gains or, if is_last, on matrices. begun: the step
    at which its moments started. views: the number of training views.
    """
    return begun + (LATER if is_last else 1) * max(LOOKS * views, LEAST_STEPS)
