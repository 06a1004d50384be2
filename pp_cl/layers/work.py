"""Scratch memory of convolutions."""

from dataclasses import dataclass

from pyopencl.array import Array

from pp_cl.device.device import Device


@dataclass
class Work:
    """Device memory for convolutions to work in; several may share one, one after the other."""

    scratch: Array  # float32, at least as many floats as the largest convolution needs
    # float32, weights flipped or transformed for a kernel, or the parts of their gradients
    weights: Array

    @classmethod
    def empty(cls, dev: Device, scratch: int, weights: int) -> "Work":
        """Room for that many floats, at least one each."""
        return cls(dev.empty(max(1, scratch)), dev.empty(max(1, weights)))

    def grow(self, dev: Device, scratch: int, weights: int) -> None:
        """Make room for that many floats, if there is less."""
        for name, floats in (("scratch", scratch), ("weights", weights)):
            if getattr(self, name).size < floats:
                setattr(self, name, None)  # frees the old array before allocating
                setattr(self, name, dev.empty(floats))
