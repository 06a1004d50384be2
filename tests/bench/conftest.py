"""Short measurements."""

import pytest

from pp_cl.bench import timing


@pytest.fixture
def quick(monkeypatch):
    """Short runs, and few of them."""
    monkeypatch.setattr(timing, "PEAK_SECONDS", 0.0)
    monkeypatch.setattr(timing, "COPY_BYTES", 2**16)
    monkeypatch.setattr(timing, "SECONDS", 0.0)
    monkeypatch.setattr(timing, "LEAST_ROUNDS", 2)
