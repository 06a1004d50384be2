"""The training loss: smooth L1 and SSIM of the rendered crop with their gradient, the mask term,
and the sum of all terms, which stay on the device until they are read.
"""

import math

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Pending, Table, read_later
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import group_items, lanes, launch_groups
from pp_cl.errors import Diverged

TAPS = 11  # pixels, the side of an SSIM window
MARGIN = 32  # values by which a scratch row is longer than needed, >= 3 * (TAPS - 1)
FURTHER = ("mask", "distortion")  # terms that not every training has


def loss_table(
    dev: Device, size: tuple[int, int], padded: tuple[int, int], ssim_weight: float
) -> Table:
    """The buffers of Loss for a target of size (height, width) in a prediction of a larger one."""
    height, width = size
    values, has_ssim = lanes_of_loss(dev), ssim_weight != 0 and min(size) >= TAPS
    window_rows = height - TAPS + 1 if has_ssim else 0
    blocks = (-(-3 * width // 16) * 16 + MARGIN) // values  # vectors in a scratch row
    return {
        "moments": ((window_rows, 4, blocks, values), np.float32),
        "derivatives": ((window_rows, 3, blocks, values), np.float32),
        "row_derivatives": ((window_rows, 3, blocks, values), np.float32),
        "partial_terms": ((window_rows + height, blocks, 4), np.float32),
        "row_terms": ((window_rows + height, 4), np.float32),
        "grad_prediction": ((*padded, 3), np.float32),
    }


class Loss:
    """L = mean D(p - t) + ssim_weight * (1 - SSIM(p, t)) over an image, and what add() adds; holds
    its scratch buffers.

    D is smooth L1 (Girshick 2015): d^2 / (2 beta) below beta, |d| - beta/2 from there on; L1 where
    beta is 0.
    SSIM (Wang et al. 2004): 11x11 Gaussian windows of sigma 1.5 inside the image, k1 .01, k2 .03,
    range 1, population variances, mean over channels and windows. It is off (its term reads 0)
    where ssim_weight is 0 or a side of the target is below 11 pixels. terms: (8,) float32 on the
    device: L, L1, 1 - SSIM, mean squared error, those of FURTHER, 0.
    """

    def __init__(self, dev: Device, ssim_weight: float, beta: float = 0.0):
        self.dev = dev
        self.beta = beta
        self.ssim_weight = ssim_weight
        self.terms = dev.zeros((8,))
        self._added: list[str] = []  # of FURTHER, in this step
        self._buffers = Buffers(dev)

    def forward_backward(
        self, prediction: Array, target: Array, left: int = 0, top: int = 0
    ) -> Array:
        """dL/dprediction, (PH, PW, 3) float32, valid until the next call; begins `terms` anew.

        prediction: (PH, PW, 3) float32, unclamped. target: (H, W, 3) float32, lies on the
        prediction's columns left..left+W and rows top..top+H; the gradient is 0 elsewhere. Raises
        ValueError where it reaches outside.
        """
        corner = corner_of(prediction.shape, target.shape, left, top)
        (height, width, _), pw, b = target.shape, prediction.shape[1], self._buffers
        padded = prediction.shape[0], prediction.shape[1]
        b.require(loss_table(self.dev, (height, width), padded, self.ssim_weight))
        window_rows, _, blocks, _ = b.moments.shape
        program = self.dev.program("training/loss", GROUP=group_items(self.dev), **self._defines)
        program.launch(
            "loss_moments",
            (blocks, window_rows),
            v=window_rows,
            w=width,
            pw=pw,
            corner=corner,
            blocks=blocks,
            prediction=prediction,
            target=target,
            moments=b.moments,
        )
        program.launch(
            "loss_similarity",
            (blocks, window_rows),
            v=window_rows,
            w=width,
            blocks=blocks,
            weight=self.ssim_weight,
            moments=b.moments,
            derivatives=b.derivatives,
            partial_terms=b.partial_terms,
        )
        program.launch(
            "loss_row_derivatives",
            (blocks, window_rows),
            v=window_rows,
            blocks=blocks,
            derivatives=b.derivatives,
            row_derivatives=b.row_derivatives,
        )
        if prediction.shape != target.shape:
            self.dev.fill(b.grad_prediction, 0)
        program.launch(
            "loss_gradient",
            (blocks, height),
            v=window_rows,
            h=height,
            w=width,
            pw=pw,
            corner=corner,
            blocks=blocks,
            beta=self.beta,
            prediction=prediction,
            target=target,
            row_derivatives=b.row_derivatives,
            grad_prediction=b.grad_prediction,
            partial_terms=b.partial_terms,
        )
        self._sum(b.partial_terms, b.row_terms)
        self._sum(b.row_terms.reshape(1, -1, 4), self.terms[:4].reshape(1, 4))
        self._added = []
        return b.grad_prediction

    def add(self, name: str, values: Array, weight: float, scale: float = 1.0) -> None:
        """Add weight times a term of FURTHER, which is scale * sum(values), to the loss.

        values: (n,) float32.
        """
        self._added.append(name)
        launch_groups(
            self.dev,
            "training/loss",
            "loss_add",
            1,
            defines=self._defines,
            n=len(values),
            term=4 + FURTHER.index(name),
            scale=scale,
            weight=weight,
            values=values,
            terms=self.terms,
        )

    def read(self, step: int) -> Pending[dict[str, float]]:
        """{"loss", "l1", "ssim", "psnr"} of the crop of a step, from 1 on, and the terms that were
        added. Asking for them raises Diverged if one is not finite.
        """
        added = list(self._added)

        def by_name(values: np.ndarray) -> dict[str, float]:
            total, l1, dissimilarity, mse, *further = map(float, values)
            terms = {
                "loss": total,
                "l1": l1,
                "ssim": 1 - dissimilarity,
                "psnr": -10 * math.log10(max(mse, 1e-10)),
                **{name: further[FURTHER.index(name)] for name in added},
            }
            broken = [name for name, value in terms.items() if not math.isfinite(value)]
            if broken:
                raise Diverged(f"the loss is not finite at step {step} ({', '.join(broken)})")
            return terms

        return read_later(self.dev, self.terms, convert=by_name)

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


class MaskLoss:
    """weight * mean (alpha - mask)^2, where pixels whose alpha is below the mask count less if a
    call says so; holds its scratch buffers.

    Without it the points reach half a spacing beyond the outline, where the network paints them
    white, and white parts of the object stay transparent.
    """

    def __init__(self, dev: Device, weight: float):
        self.dev = dev
        self.weight = weight
        self._buffers = Buffers(dev)

    def forward_backward(
        self,
        transmittance: Array,
        target_alpha: Array,
        *,
        size: tuple[int, int],
        offset: tuple[int, int],
        shortfall: float,
    ) -> tuple[Array, Array]:
        """(sums of the squares (PH,) by row, dL/dalpha (PH * PW,)), float32, valid until the next
        call.

        transmittance: (PH * PW,) of the padded image. target_alpha: (H, W) in [0, 1], below 0 where
        a pixel is ignored. size: (PH, PW). offset: (left, top) of the target in it. shortfall: 0 to
        1, weight of pixels whose alpha is below the mask.
        """
        (height, width), (h, w), (left, top) = size, target_alpha.shape, offset
        pixels = height * width
        self._buffers.require(
            {"grad_alpha": ((pixels,), np.float32), "row_term": ((height,), np.float32)}
        )
        launch_groups(
            self.dev,
            "training/mask",
            "mask_gradient",
            height,
            ph=height,
            pw=width,
            h=h,
            w=w,
            left=left,
            top=top,
            weight=self.weight,
            shortfall=shortfall,
            transmittance=transmittance,
            target_alpha=target_alpha,
            grad_alpha=self._buffers.grad_alpha,
            row_term=self._buffers.row_term,
        )
        return self._buffers.row_term, self._buffers.grad_alpha


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
    dev.program("training/mask", GROUP=group_items(dev)).launch(
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
    dev.program("training/mask", GROUP=group_items(dev)).launch(
        "ignore_gradient",
        (width, height),
        w=width,
        h=height,
        pw=grad_prediction.shape[1],
        corner=corner_of(grad_prediction.shape, (height, width, 3), *offset),
        ignored=ignored,
        grad_prediction=grad_prediction,
    )
