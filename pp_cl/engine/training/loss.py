"""The training loss: smooth L1 and SSIM of the rendered crop, and the mask term, with their
gradients; and the sum of all terms, which stay on the device until they are read.
"""

import math
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Pending, Table, read_later
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, launch_groups
from pp_cl.errors import Diverged

TAPS = 11  # pixels, the side of an SSIM window
MARGIN = 32  # values by which a scratch row is longer than needed, >= 3 * (TAPS - 1)


def loss_table(
    dev: Device, size: tuple[int, int], padded: tuple[int, int], ssim_weight: float
) -> Table:
    """The buffers of Loss for a target of size (height, width) in a prediction of size `padded`."""
    height, width = size
    values, has_ssim = lanes_of_loss(dev), ssim_weight != 0 and min(size) >= TAPS
    window_rows = height - TAPS + 1 if has_ssim else 0
    blocks = (-(-3 * width // 16) * 16 + MARGIN) // values  # vectors in a scratch row
    return {
        "moments": ((window_rows, 4, blocks, values), np.float32),
        "derivatives": ((window_rows, 3, blocks, values), np.float32),
        "row_derivatives": ((window_rows, 3, blocks, values), np.float32),
        "terms": ((window_rows + padded[0], 4), np.float32),
        "grad_prediction": ((*padded, 3), np.float32),
        "grad_alpha": ((math.prod(padded),), np.float32),
    }


class Loss:
    """L = mean D(p - t) + ssim_weight * (1 - SSIM(p, t)) over an image + mask_weight * mean (alpha
    - mask)^2, plus the distortion loss that read() is given; holds its scratch buffers.

    D is smooth L1 (Girshick 2015): d^2 / (2 beta) below beta, |d| - beta/2 from there on; L1 where
    beta is 0.
    SSIM (Wang et al. 2004): 11x11 Gaussian windows of sigma 1.5 inside the image, k1 .01, k2 .03,
    range 1, population variances, mean over channels and windows. It is off (its term reads 0)
    where ssim_weight is 0 or a side of the target is below 11 pixels.
    """

    def __init__(
        self, dev: Device, ssim_weight: float, beta: float = 0.0, mask_weight: float = 0.0
    ):
        self.dev = dev
        self.beta = beta
        self.ssim_weight = ssim_weight
        self.mask_weight = mask_weight
        self._window_rows = 0
        self._further: dict[str, tuple[float, float]] = {}  # {further term: (weight, scale)}
        self._buffers = Buffers(dev)

    def forward_backward(
        self,
        prediction: Array,
        target: Array,
        left: int = 0,
        top: int = 0,
        *,
        alphas: tuple[Array, Array] | None = None,
        shortfall: float = 1.0,
    ) -> tuple[Array, Array | None]:
        """(dL/dprediction (PH, PW, 3), dL/dalpha (PH * PW,) or None), float32, valid until the next
        call; resets the terms.

        prediction: (PH, PW, 3) float32, unclamped. target: (H, W, 3) float32, lies on the
        prediction's columns left..left+W and rows top..top+H; the gradients are 0 elsewhere.
        alphas: None without a mask term, else the prediction's transmittance (PH * PW,) and the
        target's alpha (H, W) in [0, 1], below 0 where a pixel is ignored. shortfall: 0 to 1, weight
        of pixels whose alpha is below the mask. Raises ValueError if the target reaches outside the
        prediction.
        """
        corner = corner_of(prediction.shape, target.shape, left, top)
        (height, width, _), (ph, pw, _), b = target.shape, prediction.shape, self._buffers
        b.require(loss_table(self.dev, (height, width), (ph, pw), self.ssim_weight))
        window_rows, _, blocks, _ = b.moments.shape
        shared: dict[str, Any] = {"v": window_rows, "w": width, "pw": pw, "blocks": blocks}
        shared |= {"prediction": prediction, "target": target, "terms": b.terms}
        shared["row_derivatives"] = b.row_derivatives
        self._launch(
            "loss_windows",
            window_rows,
            corner=corner,
            weight=self.ssim_weight,
            moments=b.moments,
            derivatives=b.derivatives,
            **shared,
        )
        transmittance, target_alpha = alphas or (None, None)
        self._launch(
            "loss_gradient",
            ph,
            h=height,
            ph=ph,
            left=left,
            top=top,
            beta=self.beta,
            has_mask=alphas is not None,
            mask_weight=self.mask_weight,
            shortfall=shortfall,
            transmittance=transmittance,
            target_alpha=target_alpha,
            grad_prediction=b.grad_prediction,
            grad_alpha=b.grad_alpha,
            **shared,
        )
        self._window_rows = window_rows
        self._further = {"mask": (self.mask_weight, 1 / (height * width))} if alphas else {}
        return b.grad_prediction, b.grad_alpha if alphas else None

    def read(
        self,
        step: int,
        distortion: Array | None = None,
        distortion_weight: float = 0.0,
        scale: float = 1.0,
    ) -> Pending[dict[str, float]]:
        """{"loss", "l1", "ssim", "psnr" and, if they count, "mask" and "distortion": value} of a
        step's crop; steps count from 1. Its get() raises Diverged if a value is not finite.

        distortion: (...,) float32; the distortion loss is scale * sum(distortion).
        """
        further, downloaded = dict(self._further), None
        if distortion is not None:
            further["distortion"] = distortion_weight, scale
            downloaded = read_later(self.dev, distortion)
        arguments = step, self._window_rows, self.ssim_weight, further, downloaded
        terms = self._buffers.terms
        return read_later(self.dev, terms, convert=lambda rows: _by_name(rows, *arguments))

    def _launch(self, kernel, rows, **arguments):
        defines = _defines(self.dev)
        launch_groups(self.dev, "training/loss", kernel, rows, defines=defines, **arguments)


def _by_name(rows, step, window_rows, ssim_weight, further, distortion):
    """The terms of Loss.read() from the rows that the kernels wrote. further: {term: (weight,
    scale)}. distortion: its pending values if it is one of them.
    """
    dissimilarity = rows[:window_rows].sum(0, dtype=np.float64)[0]
    smooth, l1, mse, mask = rows[window_rows:].sum(0, dtype=np.float64)
    further_sums = {"mask": mask}
    if "distortion" in further:
        further_sums["distortion"] = distortion.get().sum(dtype=np.float64)
    more = {name: float(further_sums[name] * scale) for name, (_, scale) in further.items()}
    total = smooth + ssim_weight * dissimilarity
    total += sum(more[name] * weight for name, (weight, _) in further.items())
    terms = {
        "loss": float(total),
        "l1": float(l1),
        "ssim": float(1 - dissimilarity),
        "psnr": -10 * math.log10(max(mse, 1e-10)),
        **more,
    }
    broken = [name for name, value in terms.items() if not math.isfinite(value)]
    if broken:
        raise Diverged(f"the loss is not finite at step {step} ({', '.join(broken)})")
    return terms


def _defines(dev):
    values = lanes_of_loss(dev)
    return {"LANES": values, "TAPS": TAPS, "MARGIN": MARGIN // values}


def lanes_of_loss(dev: Device) -> int:
    """LANES of the loss kernels: 4 on GPUs, as each work-item writes four terms to be summed."""
    return lanes(dev, on_gpu=4)


def corner_of(
    prediction_shape: tuple[int, ...], target_shape: tuple[int, ...], left: int, top: int
) -> int:
    """Index of the prediction's first value under a target at (left, top). Raises ValueError if the
    target reaches outside the prediction.
    """
    (ph, pw, _), (height, width, _) = prediction_shape, target_shape
    if min(left, top) < 0 or left + width > pw or top + height > ph:
        raise ValueError(
            f"target {target_shape} at ({left}, {top}) reaches outside the prediction"
            f" {prediction_shape}"
        )
    return 3 * (top * pw + left)
