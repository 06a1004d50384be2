"""The search for the smallest reduction within a loss."""

import numpy as np
import pytest

from pp_cl.compress.reduction import Original, measured_psnr
from pp_cl.compress.search import LEAST_KEPT, search


@pytest.fixture
def views(original):
    return original.run.scene("train").splits["train"][::3]


def taken(trials):
    """The last one that is taken."""
    return [trial for trial in trials if trial.taken][-1]


def test_what_is_found_loses_no_more(original, views):
    before, *trials = search(original, views, 0.5)
    assert before.taken and before.loss == 0
    assert before.psnr == pytest.approx(measured_psnr(original.run, views))
    found = taken(trials)
    again = original.reduced(found.keep, found.half)
    assert before.psnr - measured_psnr(again, views) == pytest.approx(found.loss)
    assert found.loss <= 0.5
    for trial in trials:
        assert trial.loss == pytest.approx(before.psnr - trial.psnr)
        assert trial.taken == (trial.loss <= (0.5 if trial.half and trial.keep < 1 else 0.1))
    assert found.half and found.keep < 1 and found.points == again.model.cloud.count


def test_nothing_is_lost_where_nothing_may_be(original, views):
    """All points stay but those that no view sees."""
    before, *trials = search(original, views, 0.0)
    found = taken([before, *trials])
    assert before.psnr <= measured_psnr(original.reduced(found.keep, found.half), views)


def test_a_loss_without_bound_leaves_the_least(original, views):
    found = taken(search(original, views, 20.0))
    assert found.keep == pytest.approx(LEAST_KEPT / 100) and found.half


def test_a_compressed_run_has_16_bits_already(original, views):
    small = Original(original.reduced(1.0, half=True))
    before, *trials = search(small, views, 0.0)
    assert before.half and all(trial.half and trial.keep < 1 for trial in trials)
    assert small.reduced_arrays(1.0, half=True)["points.sh0"].dtype == np.float16
