import json

import numpy as np
import pyopencl as cl
import pytest

from pp_cl.selftest.case import Case, Check, relative
from pp_cl.selftest.run import (
    HARD_HEAD,
    HEAD,
    Hard,
    Row,
    as_json,
    hard_line,
    line,
    run_case,
    run_cases,
    setup,
)


def case(*checks, name="a: case", variant=None, hard=""):
    return Case(name, lambda dev, rng: iter(checks), variant, hard)


def test_the_worst_check_is_the_one_closest_to_its_bound():
    row = run_case(None, case(Check(1.0, 100.0), Check(0.5, 1.0), Check(0.0, 0.0)))
    assert (row.error, row.bound, row.passed, row.reason) == (0.5, 1.0, True, "")
    row = run_case(None, case(Check(1.0, 100.0), Check(1.0, 0.0), Check(5.0, 1.0)))
    assert (row.error, row.bound, row.passed) == (1.0, 0.0, False)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_fails(bad):
    row = run_case(None, case(relative([0.5, bad], [0.5, 1.0], 1e9), Check(0.0, 1.0)))
    assert not row.passed and row.error == np.inf and "NaN" in row.reason


@pytest.mark.parametrize(
    "error", [cl.RuntimeError("clBuild\nfailed: " + "x" * 900), AssertionError(), MemoryError("no")]
)
def test_an_exception_fails_its_case_alone(dev, error):
    def raises(dev, rng):
        yield Check(0.0, 1.0)
        raise error

    good = case(Check(0.0, 1.0), name="b: good")
    bad, rest = run_cases(dev, [Case("a: bad", raises), good])
    assert not bad.passed and bad.error is None and bad.bound is None
    assert bad.reason.startswith(type(error).__name__)
    assert "\n" not in bad.reason and len(bad.reason) <= 300
    assert rest.passed and rest.case == "b: good"


def test_a_case_without_checks_has_checked_nothing():
    assert not run_case(None, case()).passed


def test_a_hard_case_shows_the_check_in_which_the_naive_formula_is_worst():
    checks = Check(0.9, 1.0), Check(0.5, 1.0, 4.0), Check(0.2, 1.0, np.nan), Check(0, 0, np.inf)
    for chosen, expected in ((checks[:2], (4, 0.5, 1)), (checks, (np.nan, 0.2, 1))):
        row = run_case(None, case(*chosen, hard="1 / 0"))
        assert row.hard.what == "1 / 0" and (row.error, row.bound) == (0.9, 1.0)
        worst = row.hard.naive, row.hard.error, row.hard.bound
        np.testing.assert_equal(worst, expected)
    assert run_case(None, case(*checks)).hard is None


def test_variants_that_are_not_offered_are_left_out(dev, monkeypatch):
    cases = [case(Check(0, 1), name=str(v), variant=v) for v in (None, "direct", "winograd")]
    monkeypatch.setattr(dev, "is_cpu", True)
    assert [row.case for row in run_cases(dev, cases)] == ["None", "direct", "winograd"]
    monkeypatch.setattr(dev, "is_cpu", False)
    assert [row.case for row in run_cases(dev, cases)] == ["None", "direct"]


GOOD = Row("a: good", 1.25e-7, 1e-6, True, "", 0.5)
NAN = Row("a: bad", np.inf, 1e-6, False, "NaN", 0.25)
RAISED = Row("a: raised", None, None, False, "RuntimeError: no", 0.25)
HARD = Row("a: hard", 1e-7, 1e-6, True, "", 0.5, Hard("1 / 0", np.nan, 1e-7, 1e-6))
BAD = Row("a: worse", np.inf, 0.0, False, "NaN", 0.5, Hard("x - x", 2.0, np.inf, 0.0))


def test_lines_and_json_have_every_row(dev):
    assert HEAD.split() == ["case", "worst", "error", "bound", "pass"]
    assert line(GOOD).split() == ["a:", "good", "1.2e-07", "1e-06", "yes"]
    assert line(NAN).split() == ["a:", "bad", "inf", "1e-06", "NO", "NaN"]
    assert line(RAISED).split() == ["a:", "raised", "-", "-", "NO", "RuntimeError:", "no"]
    assert HARD_HEAD.split()[2:5] == ["naive", "ours", "bound"]
    for row, words in (
        (HARD, "a: hard nan 1e-07 1e-06 yes 1 / 0"),
        (BAD, "a: worse 2 inf 0 NO x - x NaN"),
        (RAISED, "a: raised - - - NO RuntimeError: no"),
    ):
        assert " ".join(hard_line(row).split()) == words
    rows = [GOOD, NAN, RAISED, HARD, BAD]
    stored = json.loads(json.dumps(as_json(dev, rows), allow_nan=False))
    assert stored["setup"] == setup(dev) and stored["seconds"] == 2.0
    assert [row["error"] for row in stored["cases"]] == [1.25e-7, None, None, 1e-7, None]
    assert stored["cases"][2] == vars(RAISED)
    hard = [row["hard"] for row in stored["cases"][2:]]
    assert hard[:2] == [None, {"what": "1 / 0", "naive": "nan", "error": 1e-7, "bound": 1e-6}]
    assert hard[2] == {"what": "x - x", "naive": 2.0, "error": None, "bound": 0.0}
