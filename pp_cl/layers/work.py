"""Scratch memory of convolutions."""

from dataclasses import dataclass

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.tiles import LANES

COUNTERS = LANES  # floats at the start of a scratch: counters of cl/layers/winograd.h


@dataclass
class Work:
    """Device memory for convolutions to work in; several may share one, one after the other.

    scratch: float32, at least as many floats as the largest convolution needs. The first COUNTERS
    are 0 between kernels; only Winograd's use it. weights: float32, weights flipped or transformed
    for a kernel, or the parts of their gradients.
    """

    scratch: Array
    weights: Array

    @classmethod
    def empty(cls, dev: Device, scratch: int, weights: int) -> "Work":
        """Room for that many floats, at least COUNTERS and one."""
        return cls(_scratch(dev, scratch), dev.empty(max(1, weights)))

    def grow(self, dev: Device, scratch: int, weights: int) -> None:
        """Make room for that many floats, if there is less."""
        if self.scratch.size < scratch:
            self.scratch = None  # frees the old array before allocating
            self.scratch = _scratch(dev, scratch)
        if self.weights.size < weights:
            self.weights = None
            self.weights = dev.empty(weights)


def _scratch(dev, floats):
    scratch = dev.empty(max(COUNTERS, floats))
    dev.fill(scratch[:COUNTERS], 0)
    return scratch
