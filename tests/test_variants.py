"""pp_cl/variants.py: each variant computes the same convolution, in the memory that it asks for."""

import numpy as np
import pytest
from helpers import relative_error
from oracle_conv import conv, conv_gradients
from test_conv import layer

from pp_cl.conv import pack_bias, pack_weights, unpack_weights
from pp_cl.variants import (
    FASTEST,
    VARIANTS,
    Work,
    applicable,
    backward_input,
    backward_weights,
    forward,
    pick_variant,
    work_floats,
)


@pytest.mark.parametrize("k, variant", [(1, "direct"), *[(3, variant) for variant in VARIANTS]])
def test_all_directions(dev, rng, k, variant):
    c1, c2, co, height, width = 16, 32, 48, 11, 14
    weight, bias = layer(rng, c1 + c2, co, k)
    x = np.maximum(rng.normal(size=(height, width, c1 + c2)), 0).astype(np.float32)
    plain_grad = rng.normal(size=(height, width, co)).astype(np.float32)
    sources = [dev.upload(np.ascontiguousarray(s)) for s in np.split(x, [c1], 2)]
    device_weight, out, grad_out = dev.upload(pack_weights(weight)), dev.empty((height, width, co)), dev.upload(plain_grad)
    grad_weight, grad_bias = dev.empty(device_weight.shape), dev.empty(co)

    def work(direction, c=None):
        floats = work_floats(dev, variant, direction, height, device_weight.shape, c)
        return Work(*[dev.empty(max(1, n)) for n in floats])

    forward(dev, variant, sources[0], device_weight, dev.upload(pack_bias(bias)), out, True, work("forward"), sources[1])
    assert relative_error(out.get(), conv(x, weight, bias, True)) < 1e-5
    expected = conv_gradients(x, weight, plain_grad)
    backward_weights(dev, variant, sources[0], grad_out, grad_weight, grad_bias, work("weights"), sources[1])
    assert relative_error(unpack_weights(grad_weight.get(), co), expected[1]) < 1e-5
    assert relative_error(grad_bias.get(), expected[2]) < 1e-5
    for source, first, c in ((sources[0], 0, c1), (sources[1], c1, c2)):
        grad_x = dev.empty(source.shape)
        backward_input(dev, variant, source, device_weight, first, grad_out, grad_x, True, work("input", c))
        part = slice(first, first + c)
        assert relative_error(grad_x.get(), (expected[0] * (x > 0))[..., part]) < 1e-5


def test_a_variant_is_taken_where_it_can_be():
    assert applicable("winograd4", 3, 16, 48) == "winograd4"
    assert applicable("winograd4", 1, 16, 48) == applicable("winograd2", 3, 16, 3) == applicable("direct", 3, 16) == "direct"


@pytest.mark.parametrize("direction", FASTEST)
def test_shipped_choice(dev, monkeypatch, direction):
    assert pick_variant(dev, direction, 3, 64, 64, 64) == pick_variant(dev, direction, 64, 20, 64, 64) == "direct"
    assert pick_variant(dev, direction, 128, 128, 64, 64) == "winograd4"
    assert pick_variant(dev, direction, 128, 128, 20, 20) == ("winograd4" if direction == "weights" else "winograd2")
    assert pick_variant(dev, direction, 128, 128, 1, 63) == "direct"
    monkeypatch.setattr(dev, "is_cpu", False)
    assert pick_variant(dev, direction, 128, 128, 64, 64) == "direct"  # one work-item a compute unit suits no GPU
