"""tools/peak.py: the peaks do what they are credited with."""

import numpy as np
import pytest

from tools import peak as TOOL
from tools.peak import CopyBandwidth, PeakFlops


@pytest.mark.kernels  # of tools/peak.cl
def test_flops_are_those_of_a_loop_with_the_same_result(dev, monkeypatch):
    """Which is long enough to be timed."""
    monkeypatch.setattr(TOOL, "PEAK_SECONDS", 0.02)
    monkeypatch.setattr(PeakFlops, "_seconds", lambda self: 0.006 * self.rounds / 64)
    peak = PeakFlops(dev)
    assert peak.rounds == 64 * 4
    chains, operations = -1.5 + np.arange(peak.chains, dtype=np.float64), 0
    for _ in range(peak.rounds):
        chains = chains * 0.99 + 0.25
        operations += 2 * chains.size
    peak.run(-1.5, 0.99, 0.25)
    out = peak.out.get()
    np.testing.assert_allclose(out, chains.sum(), rtol=3e-6)
    assert peak.flops == operations * out.size
    assert len(out) >= dev.info["compute_units"]


def test_the_copy_copies_all_that_it_counts(dev, monkeypatch, rng):
    monkeypatch.setattr(TOOL, "COPY_BYTES", 64 * 257)
    copy = CopyBandwidth(dev)
    assert copy.bytes == 2 * 64 * 257
    copy.source.set(rng.normal(size=(257, 16)).astype(np.float32))
    copy.run()
    np.testing.assert_array_equal(copy.target.get(), copy.source.get())
