"""The specular layer: a small network of each pixel alone, of its 16 blended features and of the
direction it is seen in, whose colours times alpha are added to the image (the specular of SNeRG,
Hedman et al. 2021, section 4). It is fitted once a training has ended (training/specular.py), to
what the images then lack: reflections above all.
"""

from __future__ import annotations

import numpy as np

from pp_cl.engine.device.device import Device
from pp_cl.engine.network.layers import Layer
from pp_cl.engine.network.unet import Network

HIDDEN = 32  # channels of its two hidden layers
INPUTS = 43  # features, and a direction as cl/layers/specular.h encodes it


def specular_layers() -> list[Layer]:
    """Its layers: 1x1 convolutions of pixels in any order."""
    return [
        Layer("conv", "a", ("x",), 0, HIDDEN, (INPUTS,), 1, True),
        Layer("conv", "b", ("a",), 0, HIDDEN, (HIDDEN,), 1, True),
        Layer("conv", "c", ("b",), 0, 3, (HIDDEN,), 1, False),
    ]


class Specular(Network):
    """The specular layer of a model. Its image less 1/2 is what it adds where alpha is 1; images
    get that from layers/simple.specular_forward().
    """

    def __init__(self, dev: Device) -> None:
        super().__init__(dev, specular_layers())

    def scale(self, factor: float) -> None:
        """Multiply its colours."""
        for name in ("c.weight", "c.bias"):
            parameter = self.parameters[name]
            self.dev.write(parameter, np.float32(factor) * self.dev.download(parameter))
