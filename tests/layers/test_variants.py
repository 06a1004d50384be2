"""pp_cl/layers/variants.py: each variant computes the same convolution, in the memory that it asks
for.
"""

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from support.conv_layers import layer

from pp_cl.config import Config
from pp_cl.layers.blocking import SHIPPED
from pp_cl.layers.conv import pack_bias, pack_weights, unpack_weights
from pp_cl.layers.direction import Direction
from pp_cl.layers.policy import make_policy
from pp_cl.layers.variants import VARIANTS, ConvShape, offered
from pp_cl.layers.work import Work
from pp_cl.reference.network import flipped
from pp_cl.reference.winograd import rounding_bound
from pp_cl.selftest.hard_layers import hard_layers


def check(variant, actual, expected, x=None, weight=None):
    """Within 1e-5 of the largest value (of a channel, if a convolution of x by weight), plus half's
    rounding of weight.
    """
    bound = 1e-5 * np.abs(expected).max((0, 1) if x is not None else None)
    if x is not None and VARIANTS[variant].half:
        bound = bound + rounding_bound(4, x, weight)
    assert (np.abs(actual - expected) <= bound).all()


def check_all_directions(dev, variant, parts, weight, bias, grad_out, relu):
    """Forward, with ReLU or without, of the concatenation of `parts`, and all gradients, masked as
    relu says.
    """
    convolution = VARIANTS[variant].convolution(dev, SHIPPED["CPU"])
    x, co = np.concatenate(parts, 2), len(weight)
    sources, device_grad = tuple(dev.upload(p) for p in parts), dev.upload(grad_out)
    device_weight = dev.upload(pack_weights(weight))
    out, grad_weight, grad_bias = (
        dev.empty(grad_out.shape),
        dev.empty(device_weight.shape),
        dev.empty(-(-co // 16) * 16),
    )

    def work(direction, c):
        return Work.empty(dev, *convolution.work_floats(direction, len(x), device_weight.shape, c))

    convolution.forward(
        sources,
        device_weight,
        dev.upload(pack_bias(bias)),
        out,
        relu=relu,
        work=work(Direction.FORWARD, x.shape[2]),
    )
    check(variant, out.get(), conv(x, weight, bias, relu), x, weight)
    expected = conv_gradients(x, weight, grad_out)
    convolution.backward_weights(
        sources,
        device_grad,
        grad_weight,
        grad_bias,
        work=work(Direction.BACKWARD_WEIGHTS, x.shape[2]),
    )
    check(variant, unpack_weights(grad_weight.get(), co), expected[1])
    check(variant, grad_bias.get()[:co], expected[2])
    first = 0
    for source, plain in zip(sources, parts, strict=True):
        part = slice(first, first + plain.shape[2])
        grad_x = dev.empty(plain.shape)
        convolution.backward_input(
            device_weight,
            first,
            device_grad,
            grad_x,
            mask=source if relu else None,
            work=work(Direction.BACKWARD_INPUT, plain.shape[2]),
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


def test_where_a_variant_can_run():
    assert VARIANTS["winograd4"].can_run(3, 16, 48)
    assert not VARIANTS["winograd4"].can_run(1, 16, 48)
    assert not VARIANTS["winograd2"].can_run(3, 16, 3)
    assert VARIANTS["direct"].can_run(3, 16, 3) and VARIANTS["direct"].can_run(1, 16)


def shipped(dev, direction, ci, co, height, width, *, k=3, sources=None):
    shape = ConvShape(direction, k, sources or (ci,), co, height * width)
    return make_policy(dev).choose(shape)


@pytest.mark.parametrize("direction", Direction)
def test_shipped_choice(dev, monkeypatch, direction):
    assert shipped(dev, direction, 3, 64, 64, 64) == "direct"
    assert shipped(dev, direction, 64, 20, 64, 64) == "direct"
    assert shipped(dev, direction, 128, 128, 64, 64) == "winograd4"
    assert shipped(dev, direction, 128, 128, 20, 20) == (
        "winograd4" if direction is Direction.BACKWARD_WEIGHTS else "winograd2"
    )
    assert shipped(dev, direction, 128, 128, 1, 63) == "direct"
    assert shipped(dev, direction, 128, 128, 64, 64, k=1) == "direct"
    assert shipped(dev, direction, 48, 16, 64, 64, sources=(24, 24)) == "direct"
    assert shipped(dev, direction, 48, 16, 64, 64, sources=(16, 32)) == "winograd4"
    assert offered("CPU") == list(VARIANTS)
    monkeypatch.setattr(dev, "is_cpu", False)
    # one work-item a compute unit suits no GPU
    assert offered("GPU") == ["direct"]
    assert shipped(dev, direction, 128, 128, 64, 64) == "direct"


def test_a_variant_asked_for_runs_where_it_can(dev):
    policy = make_policy(dev, variant="winograd2")
    assert policy.choose(ConvShape(Direction.FORWARD, 3, (16,), 16, 64)) == "winograd2"
    assert policy.choose(ConvShape(Direction.FORWARD, 3, (16, 3), 16, 64)) == "direct"
    with pytest.raises(ValueError, match="fft.*auto, direct, winograd2, winograd4"):
        make_policy(dev, variant="fft")


@pytest.mark.parametrize("direction", Direction)
@pytest.mark.parametrize("ci, co, side", [(16, 16, 30), (512, 512, 64), (32, 3, 800)])
def test_the_shipped_choice_is_within_the_default_tolerance(dev, direction, ci, co, side):
    """So that nobody gets an error of 1e-3, half's, who has not asked for it."""
    shape = ConvShape(direction, 3, (ci,), co, side**2)
    chosen = make_policy(dev).choose(shape)
    assert VARIANTS[chosen].errors[3][direction] <= Config().network.tolerance
