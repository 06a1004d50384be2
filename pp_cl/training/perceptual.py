"""The perceptual term of the loss: weight * LPIPS, and its gradient."""

import math

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, launch_groups
from pp_cl.device.transfer import Reading, read_later
from pp_cl.errors import UserError
from pp_cl.layers.choice import ConvolutionPolicy
from pp_cl.metrics.lpips import BLOCKS, LEAST_SIZE, WIDTHS, Lpips, size_of, vgg_layers
from pp_cl.training.loss import corner_of

FEATURES = tuple(f"features{block}" for block in range(len(BLOCKS)))


class PerceptualLoss:
    """Adds weight * LPIPS(prediction, target) to a loss; holds the network and its feature maps.

    At weight 0 it reads no weights, allocates nothing and adds nothing. policy: of the
    convolutions. weights: of the network, None = load_weights()'s (which may raise UserError).
    """

    def __init__(
        self,
        dev: Device,
        weight: float,
        policy: ConvolutionPolicy,
        weights: dict[str, np.ndarray] | None = None,
    ):
        self.dev = dev
        self.weight = weight
        self._network = Lpips(dev, weights, policy) if weight else None
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
        shapes = {}
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
            "total": (1,),
        }
        return {name: (shape, np.float32) for name, shape in shapes.items()}

    def add(
        self,
        prediction: Array,
        target: Array,
        offset: tuple[int, int],
        *,
        grad_prediction: Array,
        terms: Array,
    ) -> None:
        """Adds weight * LPIPS to terms[0], and its gradient to grad_prediction (PH, PW, 3).

        prediction, target, offset = (left, top): as Loss.forward_backward takes them. Neither image
        is clamped. Raises UserError for a target that is too small for the network.
        """
        if self._network is None:
            return
        corner = corner_of(prediction.shape, target.shape, *offset)
        with self.dev.stage("perceptual loss"):
            maps, targets = self._forward(prediction, target, corner, terms)
            self._network.backward(
                maps.kept,
                targets,
                self.weight,
                place=maps,
                grad_image=grad_prediction,
                corner=corner,
            )

    def _forward(self, prediction, target, corner, terms):
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
            self._launch(
                "perceptual_rows",
                height,
                h=height,
                w=width,
                first=rows,
                distance=distance,
                row_term=b.row_term,
            )
            rows += height
        self._launch(
            "perceptual_sum",
            1,
            n=rows,
            weight=self.weight,
            row_term=b.row_term,
            distance=b.total,
            terms=terms,
        )
        return maps, targets

    def terms(self) -> dict[str, Reading]:
        """{"lpips": LPIPS of the last call of add()}, {} at weight 0."""
        return {"lpips": read_later(self.dev, self._buffers.total)} if self._network else {}

    def _launch(self, kernel, groups, **arguments):
        """`groups`: how often group_items() of a GPU, or one work-item of a CPU, sum."""
        defines = {"LANES": lanes(self.dev)}
        launch_groups(self.dev, "training/perceptual", kernel, groups, defines=defines, **arguments)


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
