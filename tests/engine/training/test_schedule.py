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
    refine_steps,
    rising_weight,
)
from pp_cl.settings import NetworkConfig, TrainConfig


@pytest.mark.parametrize(
    ("arguments", "values"),
    [
        ((0.5, 0.05, 0), {0: 0.5, 250: 0.49428, 25000: 0.15811, 50000: 0.05}),
        ((0.125, 0.0125, 1000), {0: 0.00125, 500: 0.08673, 1000: 0.11937, 50000: 0.0125}),
    ],
)
def test_published_rates(arguments, values):
    first, last, delay_steps = arguments
    for step, value in values.items():
        rate = learning_rate(step, 50000, first, last, delay_steps=delay_steps)
        assert rate == pytest.approx(value, abs=6e-6)


def test_gamma():
    gammas = [gamma_at(step, 50000) for step in (0, 25000, 50000)]
    assert gammas == pytest.approx([0.1, 0.031623, 0.01], abs=5e-7)


def test_the_distortion_weight_rises_from_nothing():
    weights = [rising_weight(step, 200, 3.0) for step in range(200)]
    assert weights[0] == 0 and weights[100] == pytest.approx(1.5) and max(weights) < 3
    np.testing.assert_allclose(np.diff(weights), 3 / 200)


def test_the_depth_weight_rises_in_the_last_quarter():
    weights = [late_weight(step, 200, 3.0) for step in (0, 150, 155, 160, 199)]
    assert weights == pytest.approx([0, 0, 1.5, 3, 3])


@pytest.mark.parametrize(
    "shares, iterations, changes, expected",
    [
        ("0.33,0.67", 11_000, {}, [3630, 7370]),
        ("0.33,0.67", 60, {}, [20]),  # no second one, as no pruning follows the first
        ("0.33,0.67", 500, {}, [165]),  # at the pruning at 250, points were seen only 85 times
        ("0.33,0.67", 2, {}, [1]),
        ("0.33,0.67", 60, {"train.prune_weight": 0}, [20, 40]),
        ("0.5,0.5", 100, {"train.prune_weight": 0}, [50]),
        ("1,1", 8000, {}, []),
        ("0,0", 8000, {}, []),  # the steps are not decided yet
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
    assert refine_steps(config.train) == expected


def test_ema_weight():
    weights = [ema_weight(step, 3500) for step in range(3500)]
    due = [step for step, weight in enumerate(weights) if weight]
    assert due == list(range(2975, 3500, 17))
    assert weights[2975] == 1
    assert weights[2992] == weights[due[-1]] == pytest.approx(1 - math.exp(-17 / 175))
    for steps in (1, 2, 7):  # short trainings average, too
        assert next(filter(None, (ema_weight(step, steps) for step in range(steps)))) == 1


@pytest.mark.parametrize(
    "steps, meant_for, scale", [(100, 1000, 1), (1000, 1000, 1), (9000, 1000, 1 / 3), (9000, 0, 1)]
)
def test_what_is_slower_in_longer_trainings(steps, meant_for, scale):
    settings = TrainConfig(iterations=steps, rate_steps=meant_for)
    first, last = (Rates.at(step, NetworkConfig(), settings) for step in (0, steps))
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
