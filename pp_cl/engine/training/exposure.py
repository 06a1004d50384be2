"""The colours of images that differ in exposure, white balance or more, and whether they do."""

import warnings

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import launch_groups
from pp_cl.engine.training.loss import corner_of

DECAY = 0.7  # of a view's sums from one of its steps to the next
PRIOR = 1e-3  # squares per pixel: black objects tell nothing
# steps on each view, and in all, after which it is known whether images differ in exposure, and
# so many times later, in colour: before, gains and matrices explain much of what a small model has
# not learned yet
LOOKS, LEAST_STEPS, LATER = 2, 100, 4
LEAST_SHARE = 0.25  # of the squared error that gains must explain
# The same of matrices, and of what gains leave: by then, matrices explain .02 to .18 of the error
# where the images are as cameras made them, .40 where each has a random one within 15 %.
LEAST_FULL_SHARE, LEAST_BEYOND = 0.28, 0.11
TINY = 1e-12
GAINS, MATRICES = "gains", "matrices"
HALF, MATRIX = 8, 16  # rows of a view's sums of one half of its image; the first row of its matrix


class Exposure:
    """A colour matrix for each view, relative to the views' mean, found while a training runs.

    state: (views, 19, 4) float32, of each half of the views' images the sums of products of
    (rendering, alpha) and (rendering, alpha), 4 rows, of image and (rendering, alpha), 3 rows, and
    of the image squared; then the matrix, 3 rows. is_applied: whether images are taken for those
    times the matrices, or these only look on. is_full: whether the matrices are more than a gain of
    each channel.
    """

    def __init__(self, dev: Device, views: int, is_applied: bool):
        self.dev = dev
        self.is_applied, self.is_full = is_applied, False
        state = np.zeros((views, MATRIX + 3, 4), np.float32)
        state[:, MATRIX:] = np.eye(3, 4)
        self.state = dev.upload(state)
        self._buffers = Buffers(dev)

    def target(self, view: int, image: Array, alpha: Array) -> Array:
        """(H, W, 3) float32: an image as the model's colours have it, valid until the next call.

        view: its index. image: (H, W, 3) float32, over white. alpha: (H, W) float32.
        """
        height, width = alpha.shape
        self._buffers.require({"target": ((height, width, 3), np.float32)})
        self.dev.program("training/exposure").launch(
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
        """Learn from an image as target() takes it and the prediction (PH, PW, 3), on which it
        lies at offset = (left, top).
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
        """Shares of the last steps' squared error after the best gain of each channel: what the
        views' own gains explain, and their own matrices; and what these explain of what gains
        leave. The latter two are found on one half of an image and measured on the other. 0 where
        there is no error.
        """
        sums = self.dev.download(self.state)[:, :MATRIX].astype(np.float64)
        halves = sums.reshape(-1, 2, HALF, 4)
        views = halves.sum(1)
        common = _left(views.sum(0), _gains(views.sum(0)))
        if common <= TINY:
            return 0.0, 0.0, 0.0
        own = sum(_left(view, _gains(view)) for view in views)
        gains, matrices = (
            sum(_left(a, best(b)) + _left(b, best(a)) for a, b in halves)
            for best in (_gains, _matrix)
        )
        shares = own / common, matrices / common, matrices / max(gains, TINY)
        return tuple(1 - float(left) for left in shares)

    def decide(self, is_last: bool) -> None:
        """Apply gains or matrices from now on, if they explain enough of the error. is_last: it is
        late enough to tell for matrices.
        """
        by_gains, by_matrices, beyond = self.explained()
        self.is_full = is_last and by_matrices > LEAST_FULL_SHARE and beyond > LEAST_BEYOND
        if self.is_full:
            found = f"colour ({by_matrices:.0%} of their error); a matrix of each view is"
        elif not self.is_applied and by_gains > LEAST_SHARE:
            found = (
                f"exposure or white balance ({by_gains:.0%} of their error); a gain of each view"
                " and channel is"
            )
        else:
            return
        self.is_applied = True
        told = f"the images differ in {found} found beside the model (train.exposure)"
        warnings.warn(told, stacklevel=2)

    @property
    def kind(self) -> str:
        """Of what images are taken for, for a checkpoint: GAINS, MATRICES; "": themselves."""
        if not self.is_applied:
            return ""
        return MATRICES if self.is_full else GAINS

    def restore(self, state: np.ndarray, kind: str) -> None:
        """Go on from the state of a checkpoint, and its kind."""
        self.dev.write(self.state, state)
        self.is_applied, self.is_full = kind != "", kind == MATRICES


def _gains(sums):
    """(3, 4) of the best gain of each channel, by sums (HALF, 4)."""
    gains = [sums[4 + c, c] / max(sums[c, c], TINY) for c in range(3)]
    return np.diag([*gains, 0.0])[:3]


def _matrix(sums):
    """(3, 4) best matrix, by sums (HALF, 4)."""
    prior = PRIOR * np.trace(sums[:4]) + TINY
    return np.linalg.solve(sums[:4] + prior * np.eye(4), (sums[4:7] + prior * np.eye(3, 4)).T).T


def _left(sums, matrix):
    """The squared error that a matrix (3, 4) leaves, by sums (HALF, 4)."""
    crossed = 2 * (matrix * sums[4:7]).sum()
    return sums[7, :3].sum() - crossed + np.trace(matrix @ sums[:4] @ matrix.T)


def decided_at(begun: int, views: int, *, is_last: bool = True) -> int:
    """The step after which it is known whether the images of a training differ. begun: the step at
    which its moments started. is_last: in more than exposure, too.
    """
    return begun + (LATER if is_last else 1) * max(LOOKS * views, LEAST_STEPS)
