"""The search for the smallest reduction within a loss."""

import numpy as np
import pytest

from pp_cl.compress import search as module
from pp_cl.compress.reduction import Original, measured_psnr
from pp_cl.compress.search import Search


@pytest.fixture
def views(original):
    return original.run.scene("train").splits["train"][::3]


def test_what_is_found_loses_no_more(original, views):
    search = Search(original, views, 0.5)
    trials = list(search.trials())
    found = search.found
    again = original.reduced(found.keep, found.half)
    assert search.psnr - measured_psnr(again, views) == pytest.approx(found.loss)
    assert found.loss <= 0.5
    assert found == next(trial for trial in reversed(trials) if trial.taken)
    for trial in trials:
        assert trial.loss == pytest.approx(search.psnr - trial.psnr)
        assert trial.taken == (trial.loss <= (0.5 if trial.half and trial.keep < 1 else 0.1))
    assert found.half and found.keep < 1 and found.points == again.model.cloud.count


def test_nothing_is_lost_where_nothing_may_be(original, views):
    """All points stay but those that no view sees."""
    search = Search(original, views, 0.0)
    list(search.trials())
    found = search.found
    assert search.psnr <= measured_psnr(original.reduced(found.keep, found.half), views)


def test_a_loss_without_bound_leaves_the_least(original, views):
    search = Search(original, views, 20.0)
    list(search.trials())
    assert search.found.keep == pytest.approx(module.LEAST_KEPT / 100) and search.found.half


def test_a_compressed_run_has_16_bits_already(original, views):
    small = Original(original.reduced(1.0, half=True))
    trials = list(Search(small, views, 0.0).trials())
    assert all(trial.half and trial.keep < 1 for trial in trials)
    assert small.reduced_arrays(1.0, half=True)["points.sh0"].dtype == np.float16
