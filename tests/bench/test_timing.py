"""pp_cl/bench/timing.py: runs take turns, errors are what they say."""

import numpy as np
import pytest

from pp_cl.bench import timing
from pp_cl.bench.timing import errors, interleave

pytestmark = pytest.mark.usefixtures("quick")


def test_runs_take_turns():
    calls = []
    times = interleave({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, rounds=3)
    assert "".join(calls) == "ab" * 4  # the first round is not measured
    assert [len(t) for t in times.values()] == [3, 3]
    assert len(interleave({"a": lambda: None})["a"]) == timing.LEAST_ROUNDS


def test_errors_are_what_they_say_and_hide_no_nan():
    assert errors([3.0, 5.0], [3.0, 4.0]) == (0.2, 1.0)
    assert errors([0.0], [0.0]) == (0.0, 0.0)
    with pytest.raises(FloatingPointError):
        errors([np.nan], [1.0])
