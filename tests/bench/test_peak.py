"""cl/bench/peak.cl: it does the multiply-adds, and copies the bytes, it is credited with."""

import numpy as np
import pytest

from pp_cl.bench import peak
from pp_cl.bench.peak import CopyBandwidth, PeakFlops


@pytest.fixture
def short(dev, monkeypatch):
    """A loop of 64 rounds."""
    monkeypatch.setattr(peak, "SECONDS", 0.0)
    return PeakFlops(dev)


def test_flops_are_those_of_a_loop_with_the_same_result(dev, short):
    chains, operations = -1.5 + np.arange(short.chains, dtype=np.float64), 0
    for _ in range(short.rounds):
        chains = chains * 0.99 + 0.25
        operations += 2 * chains.size
    short.run(-1.5, 0.99, 0.25)
    out = short.out.get()
    np.testing.assert_allclose(out, chains.sum(), rtol=3e-6)
    assert short.flops == operations * out.size
    assert len(out) >= dev.info["compute_units"]


def test_a_run_is_long_enough_to_be_timed(dev, monkeypatch):
    seconds = iter([0.001, 0.004, 0.021])
    monkeypatch.setattr(PeakFlops, "_seconds", lambda self: next(seconds))
    assert PeakFlops(dev).rounds == 64 * 4


def test_the_copy_copies_all_that_it_counts(dev, monkeypatch, rng):
    monkeypatch.setattr(peak, "COPY_BYTES", 64 * 257)
    copy = CopyBandwidth(dev)
    assert copy.bytes == 2 * 64 * 257
    copy.source.set(rng.normal(size=(257, 16)).astype(np.float32))
    copy.run()
    np.testing.assert_array_equal(copy.target.get(), copy.source.get())
