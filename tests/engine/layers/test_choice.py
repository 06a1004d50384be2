from types import SimpleNamespace

import pytest

from pp_cl.bench.conv import Layer, layer_errors
from pp_cl.engine.layers.choice import (
    CPUS,
    GPU,
    VARIANTS,
    blocking_of,
    can_run,
    choose,
)
from pp_cl.engine.layers.conv import DIRECTIONS, ConvShape

# {variant: {K: bounds on the relative L2 error of each direction}}: the table of
# docs/convolutions.md
DIRECT_ERRORS = {3: (9e-7, 1.3e-6, 3.5e-7), 1: (3.5e-7, 4.5e-7, 4e-7)}
ERRORS = {
    "local": DIRECT_ERRORS,
    "direct": DIRECT_ERRORS,
    "winograd": {3: (2.2e-6, 2.6e-6, 8.5e-7)},
}


@pytest.mark.usefixtures("cpu_form")
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_shipped_choice(dev, monkeypatch, direction):
    def shipped(sources, co, pixels, k=3):
        return choose(dev, ConvShape(direction, k, sources, co, (pixels, 1)))

    least = 64 if direction == "weights" else 900
    assert shipped((128,), 128, least) == "winograd"
    assert shipped((128,), 128, least - 1) == "direct"
    assert shipped((16, 32), 16, 4096) == "winograd"
    for sources, co, k in (((3,), 64, 3), ((64,), 20, 3), ((24, 24), 16, 3), ((128,), 128, 1)):
        assert shipped(sources, co, 4096, k) == "direct"
    monkeypatch.setattr(dev, "is_cpu", False)
    for k, co in ((3, 128), (3, 3), (1, 64)):
        assert shipped((128,), co, 4096, k) == "local"


def test_a_variant_asked_for_runs_where_it_can(dev):
    assert choose(dev, ConvShape("forward", 3, (16,), 16, (8, 8)), "winograd") == "winograd"
    assert choose(dev, ConvShape("forward", 3, (16, 3), 16, (8, 8)), "winograd") == "direct"
    assert choose(dev, ConvShape("forward", 1, (16,), 16, (8, 8)), "winograd") == "direct"
    with pytest.raises(ValueError, match="fft.*auto, local, direct, winograd"):
        choose(dev, ConvShape("forward", 3, (16,), 16, (8, 8)), "fft")


@pytest.mark.parametrize("width, row", [(32, 16), (16, 16), (8, 8), (4, 4), (1, 4)])
def test_a_cpu_takes_the_row_of_its_vectors(width, row):
    device = SimpleNamespace(native_vector_width_float=width)
    assert blocking_of(SimpleNamespace(is_cpu=True, device=device)) is CPUS[row]
    assert blocking_of(SimpleNamespace(is_cpu=False, device=device)) is GPU


@pytest.mark.usefixtures("cpu_form")
@pytest.mark.parametrize(
    "sources, co, side, k",
    [((16,), 16, 97, 3), ((64, 64), 32, 31, 3), ((512,), 32, 9, 3), ((48,), 3, 64, 1)],
)
def test_stated_errors_bound_what_is_measured(dev, rng, sources, co, side, k):
    layer = Layer.random(rng, (side, side), sources, co, k)
    for name in VARIANTS:
        if can_run(name, k, *sources, co):
            computed = layer.computed(dev, name, blocking_of(dev))
            for direction, bound in zip(DIRECTIONS, ERRORS[name][k], strict=True):
                assert layer_errors(layer, computed, direction)[0] <= bound, (name, direction)
