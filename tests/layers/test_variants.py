"""pp_cl/layers/variants.py: each variant computes the same convolution, in the memory that it asks
for.
"""

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from oracle.winograd import rounding_bound
from support.conv_layers import layer
from support.hard_layers import hard_layers

from pp_cl.layers.conv import pack_bias, pack_weights, unpack_weights
from pp_cl.layers.variants import (
    FASTEST,
    VARIANTS,
    Work,
    applicable,
    backward_input,
    backward_weights,
    forward,
    offered,
    pick_variant,
    work_floats,
)
from pp_cl.reference.network import flipped


def check(variant, actual, expected, x=None, weight=None):
    """Within 1e-5 of the largest value (of a channel, if a convolution of x by weight), plus half's
    rounding of weight.
    """
    bound = 1e-5 * np.abs(expected).max((0, 1) if x is not None else None)
    if x is not None and VARIANTS[variant][1]:
        bound = bound + rounding_bound(4, x, weight)
    assert (np.abs(actual - expected) <= bound).all()


def check_all_directions(dev, variant, parts, weight, bias, grad_out, relu):
    """Forward, with ReLU or without, of the concatenation of `parts`, and all gradients, masked as
    relu says.
    """
    x, co = np.concatenate(parts, 2), len(weight)
    sources, device_grad = [dev.upload(p) for p in parts], dev.upload(grad_out)
    device_weight = dev.upload(pack_weights(weight))
    out, grad_weight, grad_bias = (
        dev.empty(grad_out.shape),
        dev.empty(device_weight.shape),
        dev.empty(-(-co // 16) * 16),
    )

    def work(direction, c=None):
        floats = work_floats(dev, variant, direction, len(x), device_weight.shape, c)
        return Work(*[dev.empty(max(1, n)) for n in floats])

    forward(
        dev,
        variant,
        sources[0],
        device_weight,
        dev.upload(pack_bias(bias)),
        out,
        relu,
        work("forward"),
        *sources[1:],
    )
    check(variant, out.get(), conv(x, weight, bias, relu), x, weight)
    expected = conv_gradients(x, weight, grad_out)
    backward_weights(
        dev, variant, sources[0], device_grad, grad_weight, grad_bias, work("weights"), *sources[1:]
    )
    check(variant, unpack_weights(grad_weight.get(), co), expected[1])
    check(variant, grad_bias.get()[:co], expected[2])
    first = 0
    for source, plain in zip(sources, parts, strict=True):
        part = slice(first, first + plain.shape[2])
        grad_x = dev.empty(plain.shape)
        backward_input(
            dev,
            variant,
            source,
            device_weight,
            first,
            device_grad,
            grad_x,
            relu,
            work("input", plain.shape[2]),
        )
        check(
            variant,
            grad_x.get(),
            (expected[0] * (x > 0 if relu else 1))[..., part],
            grad_out,
            flipped(weight)[part],
        )
        first = part.stop


@pytest.mark.parametrize("k, variant", [(1, "direct"), *[(3, variant) for variant in VARIANTS]])
def test_all_directions(dev, rng, k, variant):
    weight, bias = layer(rng, 16 + 32, 48, k)
    parts = [np.maximum(rng.normal(size=(11, 14, c)), 0).astype(np.float32) for c in (16, 32)]
    check_all_directions(
        dev, variant, parts, weight, bias, rng.normal(size=(11, 14, 48)).astype(np.float32), True
    )


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", hard_layers(np.random.default_rng(7)))
def test_hard_layers(dev, rng, name, variant):
    x, weight, bias, grad_out = hard_layers(rng)[name]
    check_all_directions(dev, variant, [x], weight, bias, grad_out, False)


def test_a_variant_is_taken_where_it_can_be():
    assert applicable("winograd4", 3, 16, 48) == "winograd4"
    assert (
        applicable("winograd4", 1, 16, 48)
        == applicable("winograd2", 3, 16, 3)
        == applicable("direct", 3, 16)
        == "direct"
    )


@pytest.mark.parametrize("direction", FASTEST)
def test_shipped_choice(dev, monkeypatch, direction):
    assert (
        pick_variant(dev, direction, 3, 64, 64, 64)
        == pick_variant(dev, direction, 64, 20, 64, 64)
        == "direct"
    )
    assert pick_variant(dev, direction, 128, 128, 64, 64) == "winograd4"
    assert pick_variant(dev, direction, 128, 128, 20, 20) == (
        "winograd4" if direction == "weights" else "winograd2"
    )
    assert pick_variant(dev, direction, 128, 128, 1, 63) == "direct"
    assert pick_variant(dev, direction, 128, 128, 64, 64, k=1) == "direct"
    assert pick_variant(dev, direction, 48, 16, 64, 64, sources=(24, 24)) == "direct"
    assert pick_variant(dev, direction, 48, 16, 64, 64, sources=(16, 32)) == "winograd4"
    assert "local" not in offered(dev)
    monkeypatch.setattr(dev, "is_cpu", False)
    assert offered(dev) == list(VARIANTS)
    # one work-item a compute unit suits no GPU
    assert pick_variant(dev, direction, 128, 128, 64, 64) == "direct"


def test_auto_never_takes_half(dev):
    assert not any(VARIANTS[name][1] for choices in FASTEST.values() for _, name in choices)
