"""What the selftest does not test: values beyond float32's range, and NaN."""

import numpy as np
import pytest

from pp_cl.engine.layers import simple
from pp_cl.engine.layers.simple import (
    SHARE,
)
from pp_cl.engine.network.unet import UNet
from pp_cl.reference import network
from pp_cl.selftest.layers import gated

pytestmark = pytest.mark.kernels  # they test gate.cl, output.cl, maxpool.cl and resample.cl


@pytest.mark.exact
def test_huge_values_saturate(dev):
    values = [-3e38, -1e4, -80, 0, 80, 1e4, 3e38]
    x = np.stack(np.meshgrid(values, values), -1).reshape(1, -1, 2).astype(np.float32)
    ones = np.ones((1, x.shape[1], 1), np.float32)
    out, grad_x = gated(dev, x, ones)
    assert np.isfinite(out).all() and np.isfinite(grad_x).all()
    wide = x.astype(np.float64)
    np.testing.assert_allclose(out, network.gate(wide), rtol=1e-6, atol=1e-30)
    np.testing.assert_allclose(grad_x, network.gate_backward(wide, ones), rtol=1e-6, atol=1e-5)
    closed, opened = x[..., 1] <= -1e4, x[..., 1] >= 1e4
    assert not out[closed].any() and not grad_x[closed].any()
    positive = opened & (x[..., 0] > 0)
    np.testing.assert_array_equal(out[positive][:, 0], x[positive][:, 0])


@pytest.mark.exact
@pytest.mark.parametrize("place", [0, 1])
def test_nan_comes_through(dev, place):
    x = np.ones((1, 3, 2), np.float32)
    x[0, 1, place] = np.nan
    out, grad_x = gated(dev, x, np.ones((1, 3, 1), np.float32))
    np.testing.assert_array_equal(np.isnan(out[0, :, 0]), [False, True, False])
    assert np.isnan(grad_x[0, 1]).any() and np.isfinite(grad_x[0, ::2]).all()


@pytest.mark.exact
def test_a_nan_is_the_largest_of_its_pool(dev, rng):
    x = rng.random((4, 4, 17)).astype(np.float32)
    for i in range(4):  # each place of a 2x2 block
        x[i // 2, 2 + i % 2, i] = np.nan
    pooled = dev.zeros((2, 2, 17))
    simple.maxpool2_forward(dev, dev.upload(x), pooled)
    expected = x.reshape(2, 2, 2, 2, 17).max((1, 3))
    np.testing.assert_array_equal(pooled.get(), expected)
    assert np.isnan(expected).sum() == 4


def test_the_residual_connection_adds_to_the_network(dev, rng):
    x = rng.standard_normal((8, 12, 16)).astype(np.float32)
    x[0] = 1
    grad_y = rng.standard_normal((8, 12, 3)).astype(np.float32)
    images, grads = [], []
    for residual in (False, True):
        net = UNet(dev, (16, 16, 16), blocks="single", residual=residual)
        images.append(net.forward(dev.upload(x)).get())
        grads.append(net.backward(dev.upload(grad_y))[0].get())
    np.testing.assert_array_equal(images[1][0], images[0][0])
    np.testing.assert_allclose(images[1], images[0] + SHARE * (x[..., :3] - 1), atol=1e-6)
    grads[0][..., :3] += SHARE * grad_y
    np.testing.assert_allclose(grads[1], grads[0], atol=1e-6)
