"""The terms of a step's loss."""

import numpy as np
import pytest
from pp_cl.training.terms import StepTerms

from pp_cl.device.transfer import read_later
from pp_cl.errors import Diverged


def step_terms(dev, values, **others):
    """Of step 7."""
    readings = {name: read_later(dev, dev.upload(np.float32([v]))) for name, v in others.items()}
    return StepTerms(7, read_later(dev, dev.upload(np.float32(values))), readings)


def test_by_name(dev):
    found = step_terms(dev, [0.75, 0.5, 0.25, 0.01], mask=0.125).get()
    assert found == {
        "loss": 0.75,
        "l1": 0.5,
        "ssim": 0.75,
        "psnr": pytest.approx(20, abs=1e-6),
        "mask": 0.125,
    }
    assert step_terms(dev, [0, 0, 0, 0]).get()["psnr"] == pytest.approx(100)


@pytest.mark.parametrize(
    "values, named",
    [
        ([np.nan, 0, 0, 0], "loss"),
        ([np.inf, np.inf, 0, 0], "loss, l1"),
        ([1e30, 1e30, 0.5, np.inf], "psnr"),  # the mean square overflows before the loss does
    ],
)
def test_terms_that_are_not_finite(dev, values, named):
    with pytest.raises(Diverged, match=rf"^the loss is not finite at step 7 \({named}\)$"):
        step_terms(dev, values).get()
    with pytest.raises(Diverged, match=r"\(mask\)$"):
        step_terms(dev, [0, 0, 0, 0], mask=np.nan).get()
