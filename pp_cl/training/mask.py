"""The mask term of the loss: the rendered alpha should be the photograph's."""

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import launch_groups
from pp_cl.device.transfer import Reading, read_later


class MaskLoss:
    """Adds weight * mean (alpha - mask)^2 to a loss, for blends with a transmittance (alpha
    compositing); pixels whose alpha is below the mask count less where a call says so. At weight 0
    it allocates nothing and adds nothing.

    Without it points spread half a spacing beyond the outline, and the network hides them; what
    looks like the white that it paints over stays transparent.
    """

    def __init__(self, dev: Device, weight: float):
        self.dev = dev
        self.weight = weight
        self._buffers = Buffers(dev)
        self._measured = False

    @staticmethod
    def table(height: int, width: int) -> Table:
        """The scratch for a padded image of this size."""
        shapes = {"grad_alpha": (height * width,), "row_term": (height,), "mean": (1,)}
        return {name: (shape, np.float32) for name, shape in shapes.items()}

    def add(
        self,
        transmittance: Array | None,
        target_alpha: Array | None,
        *,
        size: tuple[int, int],
        offset: tuple[int, int],
        shortfall: float,
        terms: Array,
    ) -> Array | None:
        """Adds the term to terms[0]; returns dL/dalpha (PH * PW,) float32, valid until the next
        call, or None where there is no term.

        transmittance: (PH * PW,) of the padded image, None for a blend that has none. target_alpha:
        (H, W) in [0, 1], None for a photograph without mask. size: (PH, PW). offset: (left, top) of
        the target in it. shortfall: 0 to 1, weight of pixels whose alpha is below the mask.
        """
        self._measured = self.weight > 0 and transmittance is not None and target_alpha is not None
        if not self._measured:
            return None
        (height, width), (h, w), (left, top) = size, target_alpha.shape, offset
        self._buffers.require(self.table(height, width))
        self._launch(
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
        self._launch(
            "mask_sum",
            1,
            ph=height,
            pixels=h * w,
            weight=self.weight,
            row_term=self._buffers.row_term,
            mean=self._buffers.mean,
            terms=terms,
        )
        return self._buffers.grad_alpha

    def terms(self) -> dict[str, Reading]:
        """{"mask": the mean square of the last call of add()}, {} where there was none."""
        return {"mask": read_later(self.dev, self._buffers.mean)} if self._measured else {}

    def _launch(self, kernel, groups, **arguments):
        launch_groups(self.dev, "training/mask", kernel, groups, **arguments)
