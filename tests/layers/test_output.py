"""The residual connection around the network, and wrong shapes."""

import numpy as np
import pytest

from pp_cl.layers.output import SHARE, output_backward, output_forward, residual_backward
from pp_cl.network.unet import UNet


def test_other_shapes_are_refused(dev):
    for features, image in (((4, 5, 16), (5, 4, 3)), ((4, 5, 2), (4, 5, 3))):
        features, image = dev.zeros(features), dev.zeros(image)
        with pytest.raises(ValueError, match="is none of features"):
            output_forward(dev, image, features)
        with pytest.raises(ValueError, match="is none of features"):
            output_backward(dev, image, features)
        with pytest.raises(ValueError, match="is none of features"):
            residual_backward(dev, image, features)


def test_it_adds_to_the_network(dev, rng):
    """And leaves the background, whose features are 1, as it is."""
    x = rng.standard_normal((8, 12, 16)).astype(np.float32)
    x[0] = 1
    grad_y = rng.standard_normal((8, 12, 3)).astype(np.float32)
    images, grads = [], []
    for residual in (False, True):
        net = UNet(dev, (16, 16, 16), blocks="single", residual=residual)
        images.append(net.forward(dev.upload(x)).get())
        grads.append(net.backward(dev.upload(grad_y)).get())
    np.testing.assert_array_equal(images[1][0], images[0][0])
    np.testing.assert_allclose(images[1], images[0] + SHARE * (x[..., :3] - 1), atol=1e-6)
    grads[0][..., :3] += SHARE * grad_y
    np.testing.assert_allclose(grads[1], grads[0], atol=1e-6)
