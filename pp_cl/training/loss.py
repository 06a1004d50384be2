"""The training loss: smooth L1 + weight * (1 - SSIM), and its gradient."""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import group_items, lanes, launch_groups

TAPS = 11  # pixels, the side of an SSIM window
WHITE = 1.0  # of a target where its photograph is transparent
MARGIN = 32  # values by which a scratch row is longer than needed, >= 3 * (TAPS - 1)


class Loss:
    """L = mean D(p - t) + ssim_weight * (1 - SSIM(p, t)) over an image; holds its scratch buffers.

    D is smooth L1 (Girshick 2015): d^2 / (2 beta) below beta, |d| - beta/2 from there on; L1 where
    beta is 0.
    SSIM (Wang et al. 2004): 11x11 Gaussian windows of sigma 1.5 inside the image, k1 .01, k2 .03,
    range 1, population variances, mean over channels and windows. It is off (its term reads 0)
    where ssim_weight is 0 or a side of the target is below 11 pixels. terms: (4,) float32 on the
    device after a call: L, L1, 1 - SSIM, mean squared error.
    """

    def __init__(self, dev: Device, ssim_weight: float, beta: float = 0.0):
        self.dev = dev
        self.beta = beta
        self.ssim_weight = ssim_weight
        self.terms = dev.zeros((4,))
        self._buffers = Buffers(dev)

    @staticmethod
    def table(
        prediction_shape: tuple[int, ...],
        target_shape: tuple[int, ...],
        ssim_weight: float,
        values: int,
    ) -> Table:
        """The scratch for a prediction (PH, PW, 3) and a target (H, W, 3), and the gradient.

        values: lanes_of_loss(), those that a work-item handles.
        """
        height, width, _ = target_shape
        has_ssim = ssim_weight != 0 and min(height, width) >= TAPS
        window_rows = height - TAPS + 1 if has_ssim else 0
        blocks = (-(-3 * width // 16) * 16 + MARGIN) // values  # vectors in a scratch row
        shapes = {
            "moments": (window_rows, 4, blocks, values),
            "slopes": (window_rows, 3, blocks, values),
            "spread": (window_rows, 3, blocks, values),
            "partial_terms": (window_rows + height, blocks, 4),
            "row_terms": (window_rows + height, 4),
            "grad_prediction": tuple(prediction_shape),
        }
        return {name: (shape, np.float32) for name, shape in shapes.items()}

    def forward_backward(
        self, prediction: Array, target: Array, left: int = 0, top: int = 0
    ) -> Array:
        """dL/dprediction, (PH, PW, 3) float32, valid until the next call; sets `terms`.

        prediction: (PH, PW, 3) float32, unclamped. target: (H, W, 3) float32, lies on the
        prediction's columns left..left+W and rows top..top+H; the gradient is 0 elsewhere. Raises
        ValueError where it reaches outside.
        """
        corner = corner_of(prediction.shape, target.shape, left, top)
        height, width, _ = target.shape
        b = self._buffers
        values = lanes_of_loss(self.dev)
        b.require(self.table(prediction.shape, target.shape, self.ssim_weight, values))
        window_rows, _, blocks, _ = b.moments.shape
        rows, size = {"v": window_rows, "blocks": blocks}, (blocks, window_rows)
        images = {"prediction": prediction, "target": target}
        images |= {"pw": prediction.shape[1], "w": width, "corner": corner}
        slopes, spread, partial_terms = b.slopes, b.spread, b.partial_terms

        self._launch("loss_moments", size, moments=b.moments, **images, **rows)
        self._launch(
            "loss_similarity",
            size,
            w=width,
            weight=self.ssim_weight,
            moments=b.moments,
            slopes=slopes,
            partial_terms=partial_terms,
            **rows,
        )
        self._launch("loss_spread", size, slopes=slopes, spread=spread, **rows)
        if prediction.shape != target.shape:
            self.dev.fill(b.grad_prediction, 0)
        self._launch(
            "loss_gradient",
            (blocks, height),
            h=height,
            beta=self.beta,
            spread=spread,
            grad_prediction=b.grad_prediction,
            partial_terms=partial_terms,
            **images,
            **rows,
        )
        self._sum(partial_terms, b.row_terms)
        self._sum(b.row_terms.reshape(1, -1, 4), self.terms.reshape(1, 4))
        return b.grad_prediction

    def _sum(self, terms, sums):
        """Write sums (ROWS, 4) of terms (ROWS, M, 4)."""
        rows, m, _ = terms.shape
        launch_groups(
            self.dev,
            "training/loss",
            "loss_sum",
            rows,
            defines=self._defines,
            rows=rows,
            m=m,
            terms=terms,
            sums=sums,
        )

    def _launch(self, kernel, size, **arguments):
        program = self.dev.program("training/loss", GROUP=group_items(self.dev), **self._defines)
        program.launch(kernel, size, **arguments)

    @property
    def _defines(self):
        values = lanes_of_loss(self.dev)
        return {"LANES": values, "TAPS": TAPS, "MARGIN": MARGIN // values}


def lanes_of_loss(dev: Device) -> int:
    """LANES of its kernels: on GPUs 4, as each work-item writes four terms to be summed."""
    return lanes(dev, on_gpu=4)


def corner_of(
    prediction_shape: tuple[int, ...], target_shape: tuple[int, ...], left: int, top: int
) -> int:
    """First value of the prediction under a target at (left, top). Raises ValueError where the
    target reaches outside.
    """
    (ph, pw, _), (height, width, _) = prediction_shape, target_shape
    if min(left, top) < 0 or left + width > pw or top + height > ph:
        raise ValueError(
            f"target {target_shape} at ({left}, {top}) reaches outside the prediction"
            f" {prediction_shape}"
        )
    return 3 * (top * pw + left)
