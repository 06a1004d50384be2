"""What a training step's loss came to, which the host learns later."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pp_cl.device.transfer import Reading
from pp_cl.errors import Diverged


@dataclass(frozen=True)
class StepTerms:
    """The terms of the loss of one step, on their way to the host.

    step: its number, from 1 on. loss: Loss.terms. others: {name: of one number} of the terms that
    not every training has.
    """

    step: int
    loss: Reading
    others: dict[str, Reading]

    def get(self) -> dict[str, float]:
        """{"loss", "l1", "ssim", "psnr"} of the step's crop, and the others; waits until they are
        there. Raises Diverged if one of them is not finite.
        """
        total, l1, dissimilarity, mse = (float(x) for x in self.loss.get())
        terms = {
            "loss": total,
            "l1": l1,
            "ssim": 1 - dissimilarity,
            "psnr": -10 * math.log10(max(mse, 1e-10)),
            **{name: float(reading.get()[0]) for name, reading in self.others.items()},
        }
        broken = [name for name, value in terms.items() if not math.isfinite(value)]
        if broken:
            raise Diverged(f"the loss is not finite at step {self.step} ({', '.join(broken)})")
        return terms
