"""The cases of `pp-cl selftest`, each a test: on guarded buffers, so that they show strays and reads
of what nobody wrote as well.
"""

import pytest

from pp_cl.selftest.run import CASES, run_case

pytestmark = pytest.mark.kernels
# The simulator takes minutes for the others, and tests beside them run their kernels.
SIMULATED = ("layers", "device")


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(
            case, id=case.name, marks=() if case.name.startswith(SIMULATED) else pytest.mark.large
        )
        for case in CASES
    ],
)
def test_passes(dev, case):
    row = run_case(dev, case)
    assert row.passed, row
    assert row.case == case.name and not row.reason and row.error <= row.bound


def test_names_are_unique():
    assert len({case.name for case in CASES}) == len(CASES)
