"""Crops lie inside the image and show all of the object often enough."""

import numpy as np
import pytest
from pp_cl.training.crops import BOX_MARGIN, END_SHARE, draw_start


@pytest.mark.parametrize(
    "low, high, size, limit",
    [
        (10, 50, 16, 64),
        (20, 30, 16, 64),
        (0, 5, 16, 64),
        (60, 64, 16, 64),
        (0, 64, 64, 64),
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
    """Drawn uniformly they would hardly ever; what lies between is seen as often, within a half."""
    seen, draws = np.zeros(limit), 3000
    for i in range(draws):
        start = draw_start(np.random.default_rng(i), low, high, size, limit=limit)
        seen[start : start + size] += 1 / draws
    ends = seen[[low + BOX_MARGIN, high - BOX_MARGIN - 1]]
    assert ends == pytest.approx(END_SHARE, abs=0.03)
    inner = seen[low + BOX_MARGIN : high - BOX_MARGIN]
    fair = size / (high - low)
    assert inner.min() > min(0.5 * fair, END_SHARE - 0.03)
