from functools import partial

import numpy as np
import pytest

from pp_cl.selftest import case
from pp_cl.selftest.case import Check

ACTUAL, EXPECTED = [1.0, -2.5, 0.0], [1.0, -2.0, 0.0]
MOST = np.array([0.1, 2.0, 0.0])
MEASURES = {
    "relative": (partial(case.relative, bound=0.3), 0.25),
    "absolute": (partial(case.absolute, bound=0.6), 0.5),
    "each": (partial(case.each, bound=0.3, floor=0.5), 0.2),
    "allowed": (partial(case.allowed, most=MOST), 0.25),
    "exact": (case.exact, 1),
}


@pytest.mark.parametrize("name", MEASURES)
def test_errors_by_hand(name):
    measure, error = MEASURES[name]
    assert measure(ACTUAL, EXPECTED).error == error
    assert measure(EXPECTED, EXPECTED).error == 0
    with pytest.raises(ValueError, match="shape"):
        measure(ACTUAL[:2], EXPECTED)


@pytest.mark.parametrize("name", MEASURES)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", range(3))
def test_what_is_not_finite_exceeds_every_bound(name, bad, place):
    values = np.where(np.arange(3) == place, bad, EXPECTED)
    for check in (MEASURES[name][0](values, EXPECTED), MEASURES[name][0](EXPECTED, values)):
        assert check.error > check.bound


def test_what_must_be_zero_may_not_differ():
    zeros, actual = np.zeros(3), [0, 1e-30, 0]
    checks = case.allowed(actual, zeros, zeros), case.relative(actual, zeros, 1e-6)
    for check in (*checks, case.each(actual, zeros, 1e-6)):
        assert check.error == np.inf


def test_shares_of_bounds():
    assert case.relative(np.zeros((0, 3)), np.zeros((0, 3)), 0.0) == Check(0, 0)
    assert case.finite(np.array([1, np.nan]), np.array([np.inf])) == Check(2, 0)
    shares = [Check(*check).share for check in ((0, 0), (1, 0), (1, 4), (np.inf, 1))]
    assert shares == [0, np.inf, 0.25, np.inf]
    naive = [Check(1, *check).naive_share for check in ((0,), (0, 0), (0, 1), (4, 1), (4, np.nan))]
    assert naive == [-1, 0, np.inf, 0.25, np.inf]


@pytest.mark.parametrize("name", MEASURES)
def test_naive_formulas_are_measured_alike(name):
    measure, error = MEASURES[name]
    naive = np.array(ACTUAL, np.float32)
    assert measure(EXPECTED, EXPECTED, naive=naive)[::2] == (0, error)
    assert measure(ACTUAL, EXPECTED)[::2] == (error, None)
    with pytest.raises(ValueError, match="float64"):
        measure(EXPECTED, EXPECTED, naive=np.array(ACTUAL))
    naive[2] = np.inf
    assert measure(EXPECTED, EXPECTED, naive=naive).naive == (2 if name == "exact" else np.inf)
    naive[1] = np.nan
    assert np.isnan(measure(EXPECTED, EXPECTED, naive=naive).naive)


def test_naive_formulas_that_are_not_finite():
    assert case.finite(np.zeros(2), naive=np.float32([np.inf, 1])) == Check(0, 0, 1)
    assert np.isnan(case.finite(np.zeros(2), naive=np.float32([np.inf, np.nan])).naive)
