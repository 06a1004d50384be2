"""pp_cl/bench/conv.py: every variant is right, and its numbers are what they say."""

import pytest

from pp_cl.bench.conv import bench_conv

pytestmark = pytest.mark.usefixtures("quick")


def test_rows_of_the_layers(dev):
    rows = list(bench_conv(dev, 8, (16, 16, 32)))
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
        height, width, ci, co, k = row["shape"]
        assert row["gflops"] == pytest.approx(2e-6 * k * k * ci * co * height * width / row["ms"])
