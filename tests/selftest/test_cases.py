"""The cases of `pp-cl selftest`, each a test. The guards of the buffers show strays and reads of
what nobody wrote.
"""

import pytest

from pp_cl.selftest.run import CASES, run_case

pytestmark = pytest.mark.kernels


def marks(case):
    """Comparisons with NaN are exact; the simulator takes minutes for cases of other wings, beside
    which tests run their kernels.
    """
    if case.name == "layers: tiles":
        return pytest.mark.exact
    return () if case.name.startswith(("layers", "device")) else pytest.mark.large


@pytest.mark.parametrize("case", [pytest.param(c, id=c.name, marks=marks(c)) for c in CASES])
def test_passes(dev, case):
    row = run_case(dev, case)
    assert row.passed, row
    assert row.case == case.name and not row.reason and row.error <= row.bound


def test_names_are_unique():
    assert len({case.name for case in CASES}) == len(CASES)
