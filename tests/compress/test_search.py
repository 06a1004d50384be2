"""The search for the smallest reduction within a loss."""

from dataclasses import replace

import pytest

from pp_cl.compress import search as module
from pp_cl.compress.reduction import Reduction, measured_psnr
from pp_cl.compress.search import Search


@pytest.fixture
def views(original):
    return original.run.scene("train").splits["train"][::3]


def test_what_is_found_loses_no_more(original, views):
    search = Search(original, views, 0.5)
    trials = list(search.trials())
    found = original.reduced(search.reduction)
    assert search.psnr - measured_psnr(found, views) <= 0.5
    last = next(trial for trial in reversed(trials) if trial.taken)
    assert last.reduction == search.reduction and last.loss <= 0.5
    for trial in trials:
        assert trial.loss == pytest.approx(search.psnr - trial.psnr)
        assert not trial.taken or trial.loss <= 0.5
    assert search.reduction.half


def test_nothing_is_lost_where_nothing_may_be(original, views, monkeypatch):
    """What loses anything is refused, and all points stay but those that no view sees."""
    monkeypatch.setattr(module, "TRIALS", ((1.0, "degree", (1, 0)),))
    search = Search(original, views, 0.0)
    trials = list(search.trials())
    assert not trials[0].taken and trials[1].what.startswith("points"), "the first ends it"
    assert search.psnr <= measured_psnr(original.reduced(search.reduction), views)
    assert search.reduction.degree == 2


def test_a_loss_without_bound_leaves_the_least(original, views):
    search = Search(original, views, 20.0)
    list(search.trials())
    assert search.reduction.keep == pytest.approx(module.LEAST_KEPT / 100)
    assert search.reduction.degree == 0


def test_what_is_not_faster_is_refused(original, views, monkeypatch):
    monkeypatch.setattr(module, "TRIALS", ((1.0, "early_stop", (0.5,)),))
    taken = []
    for new in (99.0, 97.0):
        monkeypatch.setattr(module, "frame_ms", lambda runs, views, new=new: [100.0, new])
        trial = next(Search(original, views, 20.0).trials())
        taken.append(trial.taken)
        assert trial.speed == pytest.approx(100 / new)
    assert taken == [False, True]


def test_a_compressed_run_is_not_tried_again(original, views, monkeypatch):
    """Trials of what is so already, or harsher, are left out."""
    monkeypatch.setattr(module.Search, "_prune", lambda self: iter(()))
    small = replace(
        Reduction.of(original.run),
        half=True,
        early_stop=0.1,
        degree=0,
        channels=0.1,
    )
    search = Search(original, views, 20.0)
    search.reduction = small
    assert not list(search.trials())
