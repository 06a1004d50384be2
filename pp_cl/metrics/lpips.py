"""LPIPS v0.1 with VGG16 (Zhang et al. 2018): a perceptual distance, run on the convolutions of the
renderer.
"""

from itertools import islice

import numpy as np

from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.layers.blocking import Blocking, shipped_blocking
from pp_cl.layers.conv import conv_forward, pack_weights
from pp_cl.layers.resample import maxpool2_forward
from pp_cl.metrics.lpips_weights import load_weights

# convolutions between the poolings of VGG16; the last one of each block is compared
BLOCKS = (2, 2, 3, 3, 3)
LEAST_SIZE = 16  # pixels: four poolings leave one


class Lpips:
    """Distance of image pairs. weights: as load_weights() returns them, which is the default (and
    may raise UserError). blocking: of the convolutions, None = as shipped.
    """

    def __init__(
        self,
        dev: Device,
        weights: dict[str, np.ndarray] | None = None,
        blocking: Blocking | None = None,
    ):
        weights = load_weights() if weights is None else weights
        self.dev = dev
        self.blocking = blocking or shipped_blocking(dev)
        self.program = dev.program("metrics/lpips")
        self.layers = [
            (dev.upload(pack_weights(weights[f"kernel{i}"])), dev.upload(weights[f"bias{i}"]))
            for i in range(sum(BLOCKS))
        ]
        self.heads = [dev.upload(weights[f"head{i}"]) for i in range(len(BLOCKS))]

    def distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """LPIPS of two (H, W, 3) images in [0, 1].

        Raises UserError for images of less than LEAST_SIZE pixels a side, ValueError for different
        shapes.
        """
        if a.shape != b.shape:
            raise ValueError(f"a {a.shape}, b {b.shape}")
        height, width = a.shape[:2]
        if min(height, width) < LEAST_SIZE:
            raise UserError(
                f"{width}x{height} pixels, LPIPS needs {LEAST_SIZE}x{LEAST_SIZE}: "
                "take larger images or leave lpips out of --metrics"
            )
        # Both images go through a block before either goes on, so that the features of one block
        # only are held.
        features = [self._input(a), self._input(b)]
        layers = iter(self.layers)
        total = 0.0
        for block, (convolutions, head) in enumerate(zip(BLOCKS, self.heads, strict=True)):
            if block:
                features = [self._pool(x) for x in features]
            for weight, bias in islice(layers, convolutions):
                for i in range(2):
                    features[i] = self._convolve(features[i], weight, bias)
            total += self._compare(*features, head)
        return total

    def _input(self, image):
        x = self.dev.empty(image.shape)
        n = image.shape[0] * image.shape[1]
        self.program.launch(
            "lpips_input",
            n,
            n=n,
            image=self.dev.upload(image.reshape(n, 3), np.float32),
            x=x.reshape(n, 3),
        )
        return x

    def _pool(self, x):
        height, width, channels = x.shape
        out = self.dev.empty((height // 2, width // 2, channels))
        maxpool2_forward(self.dev, x, out)
        return out

    def _convolve(self, x, weight, bias):
        out = self.dev.empty((*x.shape[:2], *bias.shape))
        conv_forward(self.dev, (x,), weight, bias, out=out, relu=True, blocking=self.blocking)
        return out

    def _compare(self, a, b, head):
        channels = a.shape[2]
        n = a.size // channels
        a, b, distance = a.reshape(n, channels), b.reshape(n, channels), self.dev.empty((n,))
        self.program.launch(
            "lpips_distance", n, n=n, c=channels, a=a, b=b, head=head, distance=distance
        )
        return float(distance.get().mean(dtype=np.float64))
