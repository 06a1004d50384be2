"""The perceptual term of the loss: weight * LPIPS, and its gradient."""

import math

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, launch_groups
from pp_cl.errors import UserError
from pp_cl.layers.choice import AUTO
from pp_cl.metrics.lpips import BLOCKS, LEAST_SIZE, WIDTHS, Lpips, size_of, vgg_layers
from pp_cl.training.loss import corner_of

FEATURES = tuple(f"features{block}" for block in range(len(BLOCKS)))


class PerceptualLoss:
    """weight * LPIPS(prediction, target); holds the network and its feature maps.

    variant: of the convolutions. weights: of the network, None = load_weights()'s (which may raise
    UserError).
    """

    def __init__(
        self,
        dev: Device,
        weight: float,
        weights: dict[str, np.ndarray] | None = None,
        variant: str = AUTO,
    ):
        self.dev = dev
        self.weight = weight
        self._network = Lpips(dev, weights, variant)
        self._buffers = Buffers(dev)

    @staticmethod
    def table(target_shape: tuple[int, ...], widths: tuple[int, ...] = WIDTHS) -> Table:
        """The feature maps for a target (H, W, 3): of the prediction all outputs of convolutions,
        which the backward pass reads; of the target those that are compared; scratch for the other
        maps and for their gradients, each computed from the one before.

        Raises UserError for a target that is too small for the network.
        """
        height, width, _ = target_shape
        if min(height, width) < LEAST_SIZE:
            raise UserError(
                f"train.perceptual_weight: the training images have {width}x{height} pixels, LPIPS"
                f" needs {LEAST_SIZE}x{LEAST_SIZE}: raise train.crop, or set"
                " train.perceptual_weight=0"
            )
        shapes: dict[str, tuple[int, ...]] = {}
        for layer in vgg_layers(widths):
            shape = *size_of((height, width), layer.block), layer.co
            shapes[f"prediction_{layer.name}"] = shape
            if layer.name in FEATURES:
                shapes[f"target_{layer.name}"] = shape
        largest = max(map(math.prod, shapes.values()))
        shapes |= {
            "scratch_0": (largest,),
            "scratch_1": (largest,),
            "distance": (height * width,),
            "row_term": (sum(height >> block for block in range(len(BLOCKS))),),
        }
        return {name: (shape, np.float32) for name, shape in shapes.items()}

    def add_gradient(
        self, prediction: Array, target: Array, offset: tuple[int, int], grad_prediction: Array
    ) -> Array:
        """Adds the gradient to grad_prediction (PH, PW, 3); returns numbers (?,) float32 whose sum
        is LPIPS, valid until the next call.

        prediction, target, offset = (left, top): as Loss.forward_backward takes them. Neither image
        is clamped. Raises UserError for a target that is too small for the network.
        """
        corner = corner_of(prediction.shape, target.shape, *offset)
        with self.dev.stage("perceptual loss"):
            maps, targets = self._forward(prediction, target, corner)
            self._network.backward(
                maps.kept,
                targets,
                self.weight,
                place=maps,
                grad_image=grad_prediction,
                corner=corner,
            )
        return self._buffers.row_term

    def _forward(self, prediction, target, corner):
        """(_Places of the prediction's maps, the target's features)."""
        b, network, size = self._buffers, self._network, target.shape[:2]
        b.require(self.table(target.shape, network.widths))
        targets = list(network.features(target, size, _Places(b, "target", FEATURES)))
        outputs = [layer.name for layer in vgg_layers(network.widths)]
        maps, rows = _Places(b, "prediction", outputs), 0
        for block, features in enumerate(network.features(prediction, size, maps, corner)):
            height, width, _ = features.shape
            distance = b.distance[: height * width].reshape(height, width)
            network.compare(block, features, targets[block], distance)
            # GROUP work-items of a GPU, or one of a CPU, sum a row
            launch_groups(
                self.dev,
                "training/perceptual",
                "perceptual_rows",
                height,
                defines={"LANES": lanes(self.dev)},
                h=height,
                w=width,
                first=rows,
                distance=distance,
                row_term=b.row_term,
            )
            rows += height
        return maps, targets


class _Places:
    """Where the network puts its maps: those of `names` in the buffers `prefix`_name, the others by
    turns in the two of scratch. kept: {name: array} of the former.
    """

    def __init__(self, buffers, prefix, names):
        self.kept = {name: getattr(buffers, f"{prefix}_{name}") for name in names}
        self._scratch = buffers.scratch_0, buffers.scratch_1

    def __call__(self, name, shape):
        if name in self.kept:
            return self.kept[name]
        self._scratch = self._scratch[::-1]
        return self._scratch[0][: math.prod(shape)].reshape(shape)
