"""The specular layer: a small network that turns the 16 blended features, the viewing direction and
the place of a pixel into a colour, which is multiplied by alpha and added to the image (as in
SNeRG, Hedman et al. 2021, section 4, which has no place). After the training, training/specular.py
fits it to the residuals of the images, which are mostly reflections.
"""

from __future__ import annotations

import numpy as np

from pp_cl.engine.device.buffers import Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.network.layers import Layer, parameter_table
from pp_cl.engine.network.unet import Network

HIDDEN = 32  # channels of both hidden layers
INPUTS = 58  # features, and the direction and the place as cl/layers/specular.h encodes them


def specular_layers() -> list[Layer]:
    """1x1 convolutions: a pixel does not depend on its neighbours."""
    return [
        Layer("conv", "a", ("x",), 0, HIDDEN, (INPUTS,), 1, True),
        Layer("conv", "b", ("a",), 0, HIDDEN, (HIDDEN,), 1, True),
        Layer("conv", "c", ("b",), 0, 3, (HIDDEN,), 1, False),
    ]


class Specular(Network):
    """The specular layer of a model. Its output minus 1/2 is the colour added where alpha is 1;
    layers/simple.specular_forward() adds it to an image.
    """

    def __init__(self, dev: Device) -> None:
        super().__init__(dev, specular_layers())

    @staticmethod
    def shapes() -> Table:
        """{name: (shape, dtype)} of its parameters."""
        return parameter_table(specular_layers())

    def scale(self, factor: float) -> None:
        """Multiply its colours by a factor."""
        for name in ("c.weight", "c.bias"):
            parameter = self.parameters[name]
            self.dev.write(parameter, np.float32(factor) * self.dev.download(parameter))
