"""cl/bench/peak.cl: it does the multiply-adds, and copies the bytes, it is credited with."""

import numpy as np
import pytest

from pp_cl.bench import peak
from pp_cl.bench.peak import Copy, Peak


@pytest.fixture
def short(dev, monkeypatch):
    """A loop of 64 rounds."""
    monkeypatch.setattr(peak, "SECONDS", 0.0)
    return Peak(dev)


def test_sums_of_all_chains(short):
    chains = -1.5 + np.arange(short.chains, dtype=np.float64)
    for _ in range(short.rounds):
        chains = chains * 0.99 + 0.25
    short.run(-1.5, 0.99, 0.25)
    np.testing.assert_allclose(short.out.get(), chains.sum(), rtol=3e-6)


def test_every_chain_counts(dev, short):
    assert short.flops == 2 * 64 * 16 * short.chains * len(short.out)
    assert len(short.out) >= dev.info["compute_units"]


def test_a_run_is_long_enough_to_be_timed(dev, monkeypatch):
    seconds = iter([0.001, 0.004, 0.021])
    monkeypatch.setattr(Peak, "_seconds", lambda self: next(seconds))
    assert Peak(dev).rounds == 64 * 4


def test_the_copy_copies_all_that_it_counts(dev, monkeypatch, rng):
    monkeypatch.setattr(peak, "COPY_BYTES", 64 * 257)
    copy = Copy(dev)
    assert copy.bytes == 2 * 64 * 257
    copy.source.set(rng.normal(size=(257, 16)).astype(np.float32))
    copy.run()
    np.testing.assert_array_equal(copy.target.get(), copy.source.get())
