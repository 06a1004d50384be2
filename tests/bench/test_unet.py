"""pp_cl/bench/unet.py: every variant is right, its numbers are what they say."""

import pytest

from pp_cl.engine.network.layers import multiplications, unet_layers

pytestmark = pytest.mark.usefixtures("quick")


def test_operations_of_the_papers_network():
    """The paper's network takes about 1.0 TMAC at 800x800."""
    counted = multiplications(unet_layers((128, 256, 512)), 800, 800)
    assert counted == pytest.approx(1.0e12, rel=0.1)
