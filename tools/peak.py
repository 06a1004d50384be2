"""A device's highest speeds: multiply-adds that never leave the registers, and copies far larger
than any cache.
"""

import time
from pathlib import Path

from pp_cl.engine.device.device import Device, Program
from pp_cl.engine.layers.choice import device_class
from pp_cl.engine.layers.tiles import VECTOR

# Length of one run of PeakFlops: long against the 30 us of a launch, short enough to run between
# any two other measurements.
PEAK_SECONDS = 0.02
# Eight times what the caches of processors and GPUs hold: a copy inside a cache would be too fast.
COPY_BYTES = 2**28


def program(dev: Device, chains: int = 1) -> Program:
    """The Program of peak.cl."""
    source, options = Path(__file__).with_suffix(".cl").read_text(), dev.build_options
    return Program(dev, "peak", source, options=[*options, f"-DCHAINS={chains}"], defines={})


# Numbers of independent sums of 16 lanes to try; the fastest is taken. A CPU core needs registers
# for 2 units x 4 cycles of sums under way, and has 32 of 16 floats (16 chains), 16 of 8 (6), or 16
# of 4 (3); more sums go to memory. The width that a driver states is not always that of its code.
# On a GPU the 16 lanes of one chain are 16 chains already, and many work-items share a unit.
CHAINS = {"CPU": (3, 6, 16), "GPU": (2,)}


class PeakFlops:
    """A loop of multiply-adds in registers, long enough to be timed. flops: floating-point
    operations of one run().
    """

    def __init__(self, dev: Device):
        self.dev = dev
        kind = device_class(dev)
        per_unit, self.local = {"CPU": (64, 1), "GPU": (2048, 64)}[kind]
        self.out = dev.empty((per_unit * dev.info["compute_units"], VECTOR))
        self.chains = max(CHAINS[kind], key=self._rate)
        self._rate(self.chains)  # sets its program and rounds

    @property
    def flops(self) -> int:
        """Operations of one run(); a multiply-add counts as two."""
        return 2 * self.out.size * self.chains * self.rounds

    def run(self, first: float = 0.0, factor: float = 0.5, term: float = 1.0) -> None:
        """Run the loop and wait for it. The chains tend to term / (1 - factor): they neither
        overflow nor vanish.
        """
        self.program.launch(
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

    def _rate(self, chains):
        """Operations a second with `chains` sums, the best of five runs of PEAK_SECONDS or more."""
        self.program, self.chains, self.rounds = program(self.dev, chains), chains, 64
        self.run()  # builds the kernel
        while self._seconds() < PEAK_SECONDS:
            self.rounds *= 2
        return self.flops / min(self._seconds() for _ in range(5))

    def _seconds(self):
        start = time.perf_counter()
        self.run()
        return time.perf_counter() - start


class CopyBandwidth:
    """A copy of COPY_BYTES. bytes: how many one run() moves, read and written."""

    def __init__(self, dev: Device):
        self.dev, self.program = dev, program(dev)
        self.source = dev.zeros((COPY_BYTES // (4 * VECTOR), VECTOR))
        self.target = dev.zeros(self.source.shape)
        self.bytes = self.source.nbytes + self.target.nbytes

    def run(self) -> None:
        """Copy and wait for it."""
        self.program.launch(
            "peak_copy",
            len(self.source),
            n=len(self.source),
            source=self.source,
            target=self.target,
        )
        self.dev.finish()
