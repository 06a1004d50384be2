"""pp_cl/bench/unet.py: every variant is right, its numbers are what they say."""

import pytest

from pp_cl.bench import unet
from pp_cl.engine.layers.choice import OFFERED, device_class
from pp_cl.engine.network.layers import multiplications, unet_layers

pytestmark = pytest.mark.usefixtures("quick")


@pytest.mark.parametrize(
    "check_size, blocks", [(8, "double"), (256, "double"), (8, "single"), (8, "gated")]
)
def test_rows_of_the_network(dev, monkeypatch, check_size, blocks):
    monkeypatch.setattr(unet, "CHECK_SIZE", check_size)
    rows = list(unet.bench_unet(dev, 16, (16, 16, 32), blocks=blocks))
    names = ["auto", *OFFERED[device_class(dev)]]
    assert [row["direction"] for row in rows] == ["forward"] * len(names) + ["train"] * len(names)
    assert [row["variant"] for row in rows] == names * 2
    for row in rows:
        assert row["shape"] == [16, 16, 16, 16, 16, 32, 3] and row["blocks"] == blocks
        # ten layers
        assert 0 < row["rel_l2"] < 10 * 2e-6 and row["max_err"] > 0
    flops = 2 * multiplications(unet_layers((16, 16, 32), blocks=blocks), 16, 16)
    assert rows[0]["gflops"] == pytest.approx(flops / rows[0]["ms"] * 1e-6)
    assert rows[-1]["gflops"] == pytest.approx(3 * flops / rows[-1]["ms"] * 1e-6)


def test_operations_of_the_papers_network():
    """The paper's network takes about 1.0 TMAC at 800x800."""
    counted = multiplications(unet_layers((128, 256, 512)), 800, 800)
    assert counted == pytest.approx(1.0e12, rel=0.1)
