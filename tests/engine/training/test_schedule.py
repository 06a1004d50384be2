import math

import numpy as np
import pytest

from pp_cl.config import assign, preset
from pp_cl.engine.training.crops import BOX_MARGIN, END_SHARE, draw_start
from pp_cl.engine.training.schedule import (
    Rates,
    ema_weight,
    gamma_at,
    late_weight,
    learning_rate,
    refinements,
    rising_weight,
)
from pp_cl.settings import NetworkConfig, TrainConfig


@pytest.mark.parametrize(
    ("arguments", "values"),
    [
        ((0.5, 0.05, 0.0), {0: 0.5, 250: 0.49428, 25000: 0.15811, 50000: 0.05}),
        ((0.125, 0.0125, 0.02), {0: 0.00125, 500: 0.08673, 1000: 0.11937, 50000: 0.0125}),
    ],
)
def test_published_rates(arguments, values):
    for step, value in values.items():
        assert learning_rate(step / 50000, *arguments) == pytest.approx(value, abs=6e-6)


def test_gamma():
    gammas = [gamma_at(progress) for progress in (0, 0.5, 1)]
    assert gammas == pytest.approx([0.1, 0.031623, 0.01], abs=5e-7)


def test_the_distortion_weight_rises_from_nothing():
    weights = [rising_weight(step / 200, 3.0) for step in range(200)]
    assert weights[0] == 0 and weights[100] == pytest.approx(1.5) and max(weights) < 3
    np.testing.assert_allclose(np.diff(weights), 3 / 200)


def test_the_depth_weight_rises_in_the_last_quarter():
    weights = [late_weight(step / 200, 3.0) for step in (0, 150, 155, 160, 199)]
    assert weights == pytest.approx([0, 0, 1.5, 3, 3])


@pytest.mark.parametrize(
    "shares, iterations, changes, expected",
    [
        ("0.33,0.67", 11_000, {}, [0.33, 0.67]),
        ("0.33,0.67", 60, {}, [0.33]),  # no second one, as no pruning follows the first
        ("0.33,0.67", 500, {}, [0.33]),  # at the pruning at 250, points were seen only 85 times
        ("0.33,0.67", 60, {"train.prune_weight": 0}, [0.33, 0.67]),
        ("0.5,0.5", 100, {"train.prune_weight": 0}, [0.5]),
        ("1,1", 8000, {}, []),
        ("0,0", 8000, {}, []),  # not decided yet
    ],
)
def test_a_refinement_needs_a_pruning_since_the_one_before(shares, iterations, changes, expected):
    config = preset("tiny")
    for key, value in {
        "train.refine_at": shares,
        "train.iterations": iterations,
        **changes,
    }.items():
        assign(config, key, value, "test")
    assert refinements(config.train) == expected


def test_ema_weight():
    def of_steps(steps):
        return {n: ema_weight((n - 1) / steps, n / steps) for n in range(1, steps + 1)}

    weights = of_steps(4000)
    due = [step for step, weight in weights.items() if weight]
    assert due == list(range(3400, 4001, 20))
    assert weights[3400] == 1
    np.testing.assert_allclose([weights[step] for step in due[1:]], 1 - math.exp(-20 / 200))
    for steps in (1, 2, 7, 60):  # short trainings average each step, about as far back
        first, *others = filter(None, of_steps(steps).values())
        assert first == 1 and len(others) == steps - math.ceil(0.85 * steps)
        kept = math.prod(1 - weight for weight in others)
        assert kept == pytest.approx(math.exp(-len(others) / steps / 0.05), rel=0.1)


@pytest.mark.parametrize(
    "steps, meant_for, scale", [(100, 1000, 1), (1000, 1000, 1), (9000, 1000, 1 / 3), (9000, 0, 1)]
)
def test_what_is_slower_in_longer_trainings(steps, meant_for, scale):
    settings = TrainConfig(iterations=steps, rate_steps=meant_for)
    first, last = (Rates.at(share, steps, NetworkConfig(), settings) for share in (0, 1))
    assert (first.opacity, last.opacity) == pytest.approx((0.03 * scale, 0.01 * scale))
    assert last.sh == pytest.approx((0.05, 0.025 * scale, 0.0125 * scale))
    assert (first.network, last.network) == pytest.approx((1e-3, 1e-4))


@pytest.mark.parametrize(
    "low, high, size, limit",
    [
        (10, 50, 16, 64),
        (0, 5, 16, 64),
        (60, 64, 16, 64),
        (3, 60, 64, 64),
    ],
)
def test_crops_stay_inside_and_show_the_object(low, high, size, limit):
    starts = {
        draw_start(np.random.default_rng(i), low, high, size, limit=limit) for i in range(300)
    }
    assert min(starts) >= 0 and max(starts) + size <= limit
    for start in starts:
        shown = min(high, start + size) - max(low, start)
        assert shown == min(size, high - low)
    assert len(starts) == max(
        1, min(max(low, high - size), limit - size) - max(min(low, high - size), 0) + 1
    )


@pytest.mark.parametrize(
    "low, high, size, limit", [(10, 400, 64, 800), (0, 617, 256, 800), (17, 183, 128, 200)]
)
def test_a_quarter_of_the_crops_shows_an_end_of_the_object(low, high, size, limit):
    """Uniform draws would hardly ever; pixels between are still seen at least half as often."""
    coverage, draws = np.zeros(limit), 3000
    for i in range(draws):
        start = draw_start(np.random.default_rng(i), low, high, size, limit=limit)
        coverage[start : start + size] += 1 / draws
    ends = coverage[[low + BOX_MARGIN, high - BOX_MARGIN - 1]]
    assert ends == pytest.approx(END_SHARE, abs=0.03)
    inner = coverage[low + BOX_MARGIN : high - BOX_MARGIN]
    fair = size / (high - low)
    assert inner.min() > min(0.5 * fair, END_SHARE - 0.03)
