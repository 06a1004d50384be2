"""pp_cl/layers/variants.py: each variant computes the same convolution, in the memory that it asks
for.
"""

import numpy as np
import pytest
from support.conv_layers import layer

from pp_cl.config import Config
from pp_cl.layers.choice import SHIPPED, VARIANTS, ConvShape, make_policy, offered
from pp_cl.layers.conv import Direction
from pp_cl.selftest.convolutions import Layer, within
from pp_cl.selftest.hard_layers import hard_layers


def check_all_directions(dev, variant, layer):
    """Forward and all gradients."""
    for result in layer.results(dev, variant, SHIPPED["CPU"]):
        assert np.isfinite(result.actual).all()
        assert within(variant, result).share <= 1


@pytest.mark.parametrize(
    "k, variant", [(1, "direct"), (1, "local"), *[(3, variant) for variant in VARIANTS]]
)
def test_all_directions(dev, rng, k, variant):
    weight, bias = layer(rng, 16 + 32, 48, k)
    parts = [np.maximum(rng.normal(size=(11, 14, c)), 0).astype(np.float32) for c in (16, 32)]
    grad_out = rng.normal(size=(11, 14, 48)).astype(np.float32)
    check_all_directions(dev, variant, Layer(parts, weight, bias, grad_out, relu=True))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", hard_layers(np.random.default_rng(7)))
def test_hard_layers(dev, rng, name, variant):
    x, *others = hard_layers(rng)[name]
    check_all_directions(dev, variant, Layer([x], *others))


def test_where_a_variant_can_run():
    assert VARIANTS["winograd4"].can_run(3, 16, 48)
    assert not VARIANTS["winograd4"].can_run(1, 16, 48)
    assert not VARIANTS["winograd2"].can_run(3, 16, 3)
    for name in ("direct", "local"):
        assert VARIANTS[name].can_run(3, 16, 3) and VARIANTS[name].can_run(1, 16)


def shipped(dev, direction, ci, co, height, width, *, k=3, sources=None):
    shape = ConvShape(direction, k, sources or (ci,), co, height * width)
    return make_policy(dev).choose(shape)


@pytest.mark.usefixtures("cpu_form")
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
    made_for_gpus = ("local", "winograd2_gemm", "winograd4_gemm")
    assert offered("CPU") == [name for name in VARIANTS if name not in made_for_gpus]
    monkeypatch.setattr(dev, "is_cpu", False)
    # one work-item a compute unit suits no GPU
    assert offered("GPU") == ["local", "direct", "winograd2_gemm", "winograd4_gemm"]
    for k, co in ((3, 128), (3, 3), (1, 64)):
        assert shipped(dev, direction, 128, co, 64, 64, k=k) == "local"


def test_a_variant_asked_for_runs_where_it_can(dev):
    policy = make_policy(dev, variant="winograd2")
    assert policy.choose(ConvShape(Direction.FORWARD, 3, (16,), 16, 64)) == "winograd2"
    assert policy.choose(ConvShape(Direction.FORWARD, 3, (16, 3), 16, 64)) == "direct"
    with pytest.raises(ValueError, match="fft.*auto, local, direct, winograd2, winograd4"):
        make_policy(dev, variant="fft")


@pytest.mark.parametrize("direction", Direction)
@pytest.mark.parametrize("ci, co, side", [(16, 16, 30), (512, 512, 64), (32, 3, 800)])
def test_the_shipped_choice_is_within_the_default_tolerance(dev, direction, ci, co, side):
    """So that nobody gets an error of 1e-3, half's, who has not asked for it."""
    shape = ConvShape(direction, 3, (ci,), co, side**2)
    chosen = make_policy(dev).choose(shape)
    assert VARIANTS[chosen].errors[3][direction] <= Config().network.tolerance
