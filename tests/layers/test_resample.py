"""Pooling and upsampling: wrong shapes; the selftest compares them with float64."""

import pytest

from pp_cl.layers import resample


def test_wrong_shapes_are_refused(dev):
    small, large = dev.zeros((2, 3, 16)), dev.zeros((4, 7, 16))
    for call, given in (
        (resample.avgpool2_forward, (large, small)),
        (resample.avgpool2_backward, (None, small, large)),
        (resample.upsample2_forward, (small, large)),
        (resample.upsample2_backward, (large, small)),
    ):
        with pytest.raises(ValueError, match="expected \\(4, 6, 16\\)"):
            call(dev, *given)
    pooled = dev.zeros((2, 4, 16))
    with pytest.raises(ValueError, match="max pooling"):
        resample.maxpool2_forward(dev, large, pooled)
    with pytest.raises(ValueError, match="max pooling"):
        resample.maxpool2_backward(dev, large, pooled, large)
