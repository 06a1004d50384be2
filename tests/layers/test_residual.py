"""cl/layers/residual.cl against its formula, and the network around which it runs."""

import numpy as np
import pytest
from pp_cl.layers.residual import residual_backward, residual_forward
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.network.unet import RESIDUAL_SHARE, UNet


@pytest.mark.parametrize("width", AWKWARD_SIZES)
@pytest.mark.parametrize("channels", [3, 16, 17])
def test_forward_and_backward(dev, rng, width, channels):
    features = rng.standard_normal((5, width, channels)).astype(np.float32)
    image = rng.standard_normal((5, width, 3)).astype(np.float32)
    result, grad = dev.upload(image), dev.upload(features)
    residual_forward(dev, dev.upload(features), result, 0.25)
    assert relative_error(result.get(), image + 0.25 * (features[..., :3].astype(float) - 1)) < 1e-7
    residual_backward(dev, dev.upload(image), grad, 0.25)
    expected = features.astype(float)
    expected[..., :3] += 0.25 * image
    assert relative_error(grad.get(), expected) < 1e-7
    np.testing.assert_array_equal(grad.get()[..., 3:], features[..., 3:])


def test_other_shapes_are_refused(dev):
    for features, image in (((4, 5, 16), (5, 4, 3)), ((4, 5, 2), (4, 5, 3))):
        with pytest.raises(ValueError, match="is none of features"):
            residual_forward(dev, dev.zeros(features), dev.zeros(image), 1.0)


def test_it_adds_to_the_network(dev, rng):
    x = rng.standard_normal((8, 12, 16)).astype(np.float32)
    grad_y = rng.standard_normal((8, 12, 3)).astype(np.float32)
    images, grads = [], []
    for residual in (False, True):
        net = UNet(dev, (16, 16, 16), blocks="single")
        if residual:
            net.connect_residual()
        images.append(net.forward(dev.upload(x)).get())
        grads.append(net.backward(dev.upload(grad_y)).get())
    image = images[0] + RESIDUAL_SHARE * (x[..., :3] - 1)
    np.testing.assert_allclose(images[1], image, atol=1e-6)
    grads[0][..., :3] += RESIDUAL_SHARE * grad_y
    np.testing.assert_allclose(grads[1], grads[0], atol=1e-6)


def test_the_background_stays_what_the_network_makes_of_it(dev):
    x = np.ones((8, 8, 16), np.float32)
    net = UNet(dev, (16, 16, 16))
    image = net.forward(dev.upload(x), False).get()
    net.connect_residual()
    np.testing.assert_array_equal(net.forward(dev.upload(x), False).get(), image)
