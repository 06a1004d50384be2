"""cl/layers/resample.cl against float64."""

import numpy as np
import pytest
from oracle import layers as oracle
from support.comparisons import relative_error

from pp_cl.layers import resample as layers
from pp_cl.reference.differences import numeric_gradient
from pp_cl.reference.lpips import maxpool2, maxpool2_gradient

SHAPES = [(1, 1, 16), (1, 5, 3), (31, 33, 17), (3, 257, 32), (12, 1, 48)]


@pytest.mark.parametrize("shape", SHAPES)
def test_avgpool(dev, rng, shape):
    h, w, c = shape
    x = rng.normal(size=(2 * h, 2 * w, c)).astype(np.float32)
    out = dev.empty(shape)
    layers.avgpool2_forward(dev, dev.upload(x), out)
    assert relative_error(out.get(), oracle.avgpool2(x)) < 5e-7


@pytest.mark.parametrize("shape", SHAPES)
def test_avgpool_backward_adds_and_masks(dev, rng, shape):
    h, w, c = shape
    x = np.maximum(rng.normal(size=(2 * h, 2 * w, c)), 0).astype(np.float32)
    other, grad_out = (
        rng.normal(size=x.shape).astype(np.float32),
        rng.normal(size=shape).astype(np.float32),
    )
    grad_x = dev.upload(other)
    layers.avgpool2_backward(dev, dev.upload(x), dev.upload(grad_out), grad_x)
    assert (
        relative_error(grad_x.get(), (other + oracle.avgpool2_gradient(grad_out)) * (x > 0)) < 5e-7
    )


@pytest.mark.parametrize("shape", [(2, 2, 16), (3, 5, 3), (31, 33, 17), (257, 2, 32), (1, 9, 16)])
def test_maxpool_drops_odd_borders(dev, rng, shape):
    x = rng.normal(size=shape).astype(np.float32)
    out = dev.empty((shape[0] // 2, shape[1] // 2, shape[2]))
    layers.maxpool2_forward(dev, dev.upload(x), out)
    np.testing.assert_array_equal(out.get(), maxpool2(x))


@pytest.mark.parametrize("shape", [(2, 2, 16), (3, 5, 3), (31, 33, 17), (257, 2, 32), (1, 9, 16)])
def test_maxpool_backward_adds_at_the_first_of_the_largest(dev, rng, shape):
    # few levels: many equal ones, and cells of zeros, which receive nothing
    x = np.maximum(rng.integers(-3, 3, shape), 0).astype(np.float32)
    others = rng.normal(size=shape).astype(np.float32)
    grad_out = rng.normal(size=(shape[0] // 2, shape[1] // 2, shape[2])).astype(np.float32)
    grad_x = dev.upload(others)
    layers.maxpool2_backward(dev, dev.upload(x), dev.upload(grad_out), grad_x)
    expected = others + maxpool2_gradient(x, grad_out) * (x > 0)
    assert relative_error(grad_x.get(), expected) < 5e-7


@pytest.mark.parametrize("shape", SHAPES)
def test_upsample(dev, rng, shape):
    h, w, c = shape
    x, grad_out = (
        rng.normal(size=shape).astype(np.float32),
        rng.normal(size=(2 * h, 2 * w, c)).astype(np.float32),
    )
    out, grad_x = dev.empty(grad_out.shape), dev.empty(shape)
    layers.upsample2_forward(dev, dev.upload(x), out)
    layers.upsample2_backward(dev, dev.upload(grad_out), grad_x)
    assert relative_error(out.get(), oracle.upsample2(x)) < 5e-7
    assert relative_error(grad_x.get(), oracle.upsample2_gradient(grad_out)) < 1e-6


def test_avgpool_backward_without_a_mask_only_adds(dev, rng):
    other = rng.normal(size=(6, 10, 17)).astype(np.float32)
    grad_out = rng.normal(size=(3, 5, 17)).astype(np.float32)
    grad_x = dev.upload(other)
    layers.avgpool2_backward(dev, None, dev.upload(grad_out), grad_x)
    assert relative_error(grad_x.get(), other + oracle.avgpool2_gradient(grad_out)) < 5e-7


def test_gradients_by_finite_differences(dev, rng):
    x, grad_pooled = rng.uniform(0.5, 1, (4, 6, 2)), rng.normal(size=(2, 3, 2)).astype(np.float32)
    grad_x = dev.zeros(x.shape)
    layers.avgpool2_backward(dev, dev.upload(x, np.float32), dev.upload(grad_pooled), grad_x)
    numeric = numeric_gradient(lambda v: (oracle.avgpool2(v) * grad_pooled).sum(), x, 1e-4)
    assert relative_error(grad_x.get().ravel(), numeric) < 1e-6

    x = rng.permutation(48).reshape(4, 6, 2) + 1.0  # no two are equal
    numeric = numeric_gradient(lambda v: (maxpool2(v) * grad_pooled).sum(), x, 1e-4)
    grad_x = dev.zeros(x.shape)
    layers.maxpool2_backward(dev, dev.upload(x, np.float32), dev.upload(grad_pooled), grad_x)
    assert relative_error(grad_x.get().ravel(), numeric) < 1e-6

    grad_out = rng.normal(size=(8, 12, 2)).astype(np.float32)
    layers.upsample2_backward(dev, dev.upload(grad_out), grad_x)
    numeric = numeric_gradient(lambda v: (oracle.upsample2(v) * grad_out).sum(), x, 1e-4)
    assert relative_error(grad_x.get().ravel(), numeric) < 1e-6


def test_upsample_keeps_constants(dev):
    """Weights that do not add up to one would show at the borders."""
    out = dev.empty((6, 10, 16))
    layers.upsample2_forward(dev, dev.upload(np.full((3, 5, 16), 1e3, np.float32)), out)
    assert (out.get() == 1e3).all()


def test_affine(dev, rng):
    x = rng.normal(size=(31, 33, 3)).astype(np.float32)
    out = dev.upload(x)
    layers.affine(dev, 0.5, 0.25, out, out=out)
    assert relative_error(out.get(), 0.5 * x.astype(np.float64) + 0.25) < 1e-7


def test_wrong_shapes_are_refused(dev):
    small, large = dev.zeros((2, 3, 16)), dev.zeros((4, 7, 16))
    for call in (layers.avgpool2_forward, layers.upsample2_backward):
        with pytest.raises(ValueError, match="expected \\(4, 6, 16\\)"):
            call(dev, large, small)
    with pytest.raises(ValueError, match="expected \\(4, 6, 16\\)"):
        layers.upsample2_forward(dev, small, large)
    with pytest.raises(ValueError, match="max pooling"):
        layers.maxpool2_forward(dev, large, dev.zeros((2, 4, 16)))
    with pytest.raises(ValueError, match="max pooling"):
        layers.maxpool2_backward(dev, large, dev.zeros((2, 4, 16)), large)
    with pytest.raises(ValueError, match="affine"):
        layers.affine(dev, 1, 0, small, out=large)
