"""pp_cl/bench/conv.py: every variant is right, and its numbers are what they say."""

import numpy as np
import pytest
from support.benches import KEYS

from pp_cl.bench.conv import RandomConv, bench_conv
from pp_cl.bench.timing import errors
from pp_cl.layers.choice import OFFERED, blocking_of, device_class
from pp_cl.layers.conv_direct import Direction

pytestmark = pytest.mark.usefixtures("quick")


@pytest.mark.usefixtures("cpu_form")
@pytest.mark.parametrize(
    "k, sources, co, choice", [(3, (16, 48), 32, True), (3, (3,), 16, False), (1, (32,), 3, False)]
)
@pytest.mark.parametrize("direction", Direction)
def test_a_layer_is_compared_with_the_truth(dev, direction, k, sources, co, choice):
    conv, blocking = RandomConv(dev, k, 13, sources, co=co), blocking_of(dev)
    assert conv.variants == ([*OFFERED[device_class(dev)]] if choice else ["direct"])
    for variant in conv.variants:
        actual, expected = conv.result(variant, direction, blocking)
        assert actual.shape == expected.shape and expected.dtype == np.float64
        assert np.abs(expected).max() > 0.1
        assert errors(actual, expected)[0] < 1e-5


def test_rows_of_the_layers(dev):
    rows = list(bench_conv(dev, 8, (16, 16, 32)))
    assert all(row.keys() >= KEYS for row in rows)
    # enc0.b and dec0.b are one layer, as are enc1.b and dec1.b
    found = list(dict.fromkeys((row["layer"], row["direction"]) for row in rows))
    assert [direction for _, direction in found] == ["forward", "input", "weights"] * 9
    assert (
        " ".join(layer for layer, _ in found[::3])
        == "enc0.a enc1.a enc2.a enc2.b up1 dec1.a up0 dec0.a out"
    )
    shapes = {row["layer"]: row["shape"] for row in rows}
    assert shapes["dec1.a"] == [4, 4, 32, 16, 3] and shapes["out"] == [8, 8, 16, 3, 1]
    for row in rows:
        assert row["rel_l2"] < 1e-5
        assert row["peak_share"] == pytest.approx(row["gflops"] / row["peak_gflops"])
        height, width, ci, co, k = row["shape"]
        assert row["gflops"] == pytest.approx(2e-6 * k * k * ci * co * height * width / row["ms"])
