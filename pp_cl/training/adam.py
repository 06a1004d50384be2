"""Adam of the network and of the opacities, and exponential moving averages (EMA) of parameters.

Adam is torch's: every value moves in every step by its momentum, whether it received a gradient or
not. The SH coefficients have a step of their own (rmsprop.py).
"""

import math

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import lanes

BETA1, BETA2 = 0.9, 0.999  # Kingma & Ba 2015


def _program(dev, **defines):
    decays = {"DECAY1": f"{1 - BETA1:.9g}f", "DECAY2": f"{1 - BETA2:.9g}f"}
    return dev.program("training/adam", LANES=lanes(dev), **decays, **defines)


def _rate_and_eps(step, rate, eps):
    """The kernels' scalars: rate (m/c1) / (sqrt(v/c2) + eps) is (rate sqrt(c2)/c1) m / (sqrt(v) +
    eps sqrt(c2)).
    """
    root = math.sqrt(1 - BETA2**step)
    return {"rate": rate * root / (1 - BETA1**step), "eps": eps * root}


def _same_shape(**arrays):
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"arrays of one shape wanted: {shapes}")


def adam_update(
    dev: Device,
    parameter: Array,
    grad: Array,
    moments: dict[str, Array],
    *,
    step: int,
    rate: float,
    eps: float,
    bounded: bool = False,
) -> None:
    """One dense Adam step of `parameter`, in place.

    parameter, grad, moments "m" and "v": float32 arrays of one shape, any; the moments start as
    zeros. step: from 1 on. bounded: the parameter stays in [0, 1]. Raises ValueError when the
    shapes differ.
    """
    _same_shape(parameter=parameter, grad=grad, **moments)
    _program(dev, BOUNDED=int(bounded)).launch(
        "adam_update",
        -(-parameter.size // lanes(dev)),
        n=parameter.size,
        grad=grad,
        parameter=parameter,
        **moments,
        **_rate_and_eps(step, rate, eps),
    )


def ema_update(dev: Device, ema: Array, parameter: Array, weight: float) -> None:
    """Move an EMA, in place: ema += weight * (parameter - ema). A weight of 1 copies, whatever it
    held.

    ema, parameter: float32 arrays of one shape, any. Raises ValueError when the shapes differ.
    """
    _same_shape(ema=ema, parameter=parameter)
    if weight == 1:
        dev.copy(ema, parameter)
        return
    _program(dev).launch(
        "ema_update",
        -(-parameter.size // lanes(dev)),
        n=parameter.size,
        weight=weight,
        parameter=parameter,
        ema=ema,
    )


class Ema:
    """Exponential moving averages of named parameters.

    arrays: {name: float32 array like the parameter}, empty before the first update.
    """

    def __init__(self, dev: Device):
        self.dev = dev
        self.arrays: dict[str, Array] = {}

    def update(self, parameters: dict[str, Array], weight: float) -> None:
        """Move the averages towards the parameters by `weight`; the first call starts them there,
        as does a weight of 1.
        """
        for name, parameter in parameters.items():
            if name in self.arrays:
                ema_update(self.dev, self.arrays[name], parameter, weight)
            else:
                self.arrays[name] = self.dev.empty(parameter.shape)
                self.dev.copy(self.arrays[name], parameter)

    def apply(self, parameters: dict[str, Array]) -> None:
        """Copy the averages, if there are any, into the parameters and release them."""
        for name in list(self.arrays):
            self.dev.copy(parameters[name], self.arrays.pop(name))

    def restore(self, parameters: dict[str, Array], stored: dict[str, np.ndarray]) -> None:
        """Take over stored averages, by the parameters' names. Raises ValueError for another
        size.
        """
        for name, array in stored.items():
            self.arrays[name] = self.dev.upload(array.reshape(parameters[name].shape))
