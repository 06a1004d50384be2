"""Runs take turns, errors are what they say, and the peaks do what they are credited with."""

import numpy as np
import pytest

from pp_cl.bench import timing
from pp_cl.bench.timing import CopyBandwidth, PeakFlops, errors, interleave

pytestmark = [pytest.mark.usefixtures("quick"), pytest.mark.kernels]  # of cl/bench/peak.cl


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


def test_flops_are_those_of_a_loop_with_the_same_result(dev):
    peak = PeakFlops(dev)
    chains, operations = -1.5 + np.arange(peak.chains, dtype=np.float64), 0
    for _ in range(peak.rounds):
        chains = chains * 0.99 + 0.25
        operations += 2 * chains.size
    peak.run(-1.5, 0.99, 0.25)
    out = peak.out.get()
    np.testing.assert_allclose(out, chains.sum(), rtol=3e-6)
    assert peak.flops == operations * out.size
    assert len(out) >= dev.info["compute_units"]


def test_a_run_is_long_enough_to_be_timed(dev, monkeypatch):
    monkeypatch.setattr(timing, "PEAK_SECONDS", 0.02)
    monkeypatch.setattr(PeakFlops, "_seconds", lambda self: 0.006 * self.rounds / 64)
    assert PeakFlops(dev).rounds == 64 * 4


def test_the_copy_copies_all_that_it_counts(dev, monkeypatch, rng):
    monkeypatch.setattr(timing, "COPY_BYTES", 64 * 257)
    copy = CopyBandwidth(dev)
    assert copy.bytes == 2 * 64 * 257
    copy.source.set(rng.normal(size=(257, 16)).astype(np.float32))
    copy.run()
    np.testing.assert_array_equal(copy.target.get(), copy.source.get())
