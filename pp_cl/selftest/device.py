"""Cases of prefix sums and moved rows; they are exact, since all values are integers or copies."""

from itertools import product

import numpy as np

from pp_cl.engine.device.buffers import compact_rows, gather_rows
from pp_cl.engine.device.launch import LARGEST_GROUP
from pp_cl.engine.device.scan import BLOCK, exclusive_scan, nonzero, read_total
from pp_cl.selftest.case import SIZES, Case, exact


def _scan(dev, rng):
    """Sizes of one block, near its end, and of many blocks; sums beyond 32 bits."""
    for n in (*SIZES, BLOCK, BLOCK + 1, 700 * BLOCK + 1):
        values = rng.integers(0, 9, n, dtype=np.uint32)
        offsets = dev.empty((n + 1,), np.uint32)
        exclusive_scan(dev, dev.upload(values), offsets)
        yield exact(offsets.get(), np.concatenate([[0], np.cumsum(values)]))
    # within a group, and from one block to the next, sums stay at the largest uint
    for n in (3, LARGEST_GROUP, 2 * BLOCK + 7):
        for value in (2**31 - 1, 2**29 + 1):
            offsets = dev.empty((n + 1,), np.uint32)
            exclusive_scan(dev, dev.upload(np.full(n, value), np.uint32), offsets)
            naive = np.arange(n + 1, dtype=np.uint32) * np.uint32(value)
            yield exact(offsets.get(), np.minimum(np.arange(n + 1) * value, 2**32 - 1), naive=naive)


def _nonzero(dev, rng):
    for n, share in product((*SIZES, BLOCK + 1), (0.0, 0.3, 1.0)):
        flags = rng.integers(1, 256, n) * (rng.random(n) < share)
        indices = dev.empty((n,), np.uint32)
        places = dev.upload(np.full(n, 7), np.uint32)
        count = dev.empty((1,), np.uint32)
        nonzero(dev, dev.upload(flags, np.uint8), indices, places, count)
        total = read_total(dev, count).get()
        yield exact(indices.get()[:total], np.flatnonzero(flags))
        expected = np.where(flags, np.cumsum(flags != 0) - 1, 7)
        yield exact(places.get(), expected)


def _compact(dev, rng):
    """Every bit is kept, also of NaN."""
    for n in SIZES:
        source = rng.integers(0, 2**32, (n, 3, 16), dtype=np.uint32)
        chosen = np.flatnonzero(rng.random(n) < 0.6) if n > 1 else np.zeros(1, int)
        rows = compact_rows(dev, dev.upload(source.view(np.float32)), dev.upload(chosen, np.uint32))
        yield exact(rows.get().view(np.uint32), source[chosen])
        repeated = rng.integers(0, n, 3 * n)
        gathered = gather_rows(dev, dev.upload(source), dev.upload(repeated, np.uint32))
        yield exact(gathered.get(), source[repeated])


CASES = (
    Case("device: scan", _scan, hard="sums of 32 bits wrap around"),
    Case("device: list of non-zero values", _nonzero),
    Case("device: compact and gather rows", _compact),
)
