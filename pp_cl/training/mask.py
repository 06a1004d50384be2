"""The mask term of the loss: the squared difference of the rendered alpha and the photograph's
mask.

Without it the points reach half a spacing beyond the outline, where the network paints them white,
and white parts of the object stay transparent.
"""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import launch_groups


class MaskLoss:
    """weight * mean (alpha - mask)^2, where pixels whose alpha is below the mask count less if a
    call says so; holds its scratch buffers.
    """

    def __init__(self, dev: Device, weight: float):
        self.dev = dev
        self.weight = weight
        self._buffers = Buffers(dev)

    @staticmethod
    def table(height: int, width: int) -> Table:
        """The scratch for a padded image of this size."""
        return {
            "grad_alpha": ((height * width,), np.float32),
            "row_term": ((height,), np.float32),
        }

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

        transmittance: (PH * PW,) of the padded image. target_alpha: (H, W) in [0, 1]. size: (PH,
        PW). offset: (left, top) of the target in it. shortfall: 0 to 1, weight of pixels whose
        alpha is below the mask.
        """
        (height, width), (h, w), (left, top) = size, target_alpha.shape, offset
        self._buffers.require(self.table(height, width))
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
