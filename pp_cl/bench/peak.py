"""The measured peaks of a device: multiply-adds that never leave the registers, and copies far
larger than any cache.
"""

import time

from pp_cl.device.device import Device
from pp_cl.layers.choice import device_class
from pp_cl.layers.tiles import VECTOR

# Of one run: long against the 30 us of a launch, short enough to run between any two others.
SECONDS = 0.02

# Eight times what the caches of processors and GPUs hold: a copy inside a cache would be too fast.
COPY_BYTES = 2**28


class PeakFlops:
    """A loop of multiply-adds in registers, long enough to be timed. flops: floating-point
    operations of one run().
    """

    def __init__(self, dev: Device):
        self.dev = dev
        # A CPU core needs 2 units x 4 cycles of chains and has 32 vector registers. On a GPU the 16
        # lanes of one chain are 16 chains already, and many work-items share a unit.
        self.chains, per_unit, self.local = {"CPU": (16, 64, 1), "GPU": (2, 2048, 64)}[
            device_class(dev)
        ]
        self.out = dev.empty((per_unit * dev.info["compute_units"], VECTOR))
        self.rounds = 64
        self.run()  # builds the kernel
        while self._seconds() < SECONDS:
            self.rounds *= 2

    @property
    def flops(self) -> int:
        """A multiply-add counts as two."""
        return 2 * self.out.size * self.chains * self.rounds

    def run(self, first: float = 0.0, factor: float = 0.5, term: float = 1.0) -> None:
        """Run the loop and wait for it. The chains tend to term / (1 - factor): they neither
        overflow nor vanish.
        """
        self.dev.program("bench/peak", CHAINS=self.chains).launch(
            "peak",
            len(self.out),
            local=self.local,
            n=len(self.out),
            rounds=self.rounds,
            first=first,
            factor=factor,
            term=term,
            out=self.out,
        )
        self.dev.finish()

    def _seconds(self):
        start = time.perf_counter()
        self.run()
        return time.perf_counter() - start


class CopyBandwidth:
    """A copy of COPY_BYTES. bytes: moved by one run(), read and written."""

    def __init__(self, dev: Device):
        self.dev = dev
        self.source = dev.zeros((COPY_BYTES // (4 * VECTOR), VECTOR))
        self.target = dev.zeros(self.source.shape)
        self.bytes = self.source.nbytes + self.target.nbytes

    def run(self) -> None:
        """Copy and wait for it."""
        self.dev.program("bench/peak").launch(
            "peak_copy",
            len(self.source),
            n=len(self.source),
            source=self.source,
            target=self.target,
        )
        self.dev.finish()
