"""The cases of `pp-cl selftest`, each a test."""

import pytest

from pp_cl.selftest.run import CASES, run_case


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_passes(dev, case):
    row = run_case(dev, case)
    assert row.passed, row
    assert row.case == case.name and not row.reason and row.error <= row.bound


def test_names_are_unique():
    assert len({case.name for case in CASES}) == len(CASES)
