"""The learning rates of a step."""

import pytest
from pp_cl.training.optimiser import Rates

from pp_cl.settings import NetworkConfig, TrainConfig


@pytest.mark.parametrize(
    "steps, meant_for, scale", [(100, 1000, 1), (1000, 1000, 1), (9000, 1000, 1 / 3), (9000, 0, 1)]
)
def test_opacities_are_slower_in_longer_trainings(steps, meant_for, scale):
    settings = TrainConfig(iterations=steps, opacity_rate_steps=meant_for)
    first, last = (Rates.at(step, NetworkConfig(), settings) for step in (0, steps))
    assert (first.opacity, last.opacity) == pytest.approx((0.1 * scale, 0.01 * scale))
    assert (first.network, last.network) == pytest.approx((1e-3, 1e-4))
