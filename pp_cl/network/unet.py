"""The U-Net on a device: its parameters, and its layers run in order, forward and backward."""

import math
from collections.abc import Sequence

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.choice import ConvolutionPolicy, make_policy
from pp_cl.layers.conv import Direction, pack_bias, pack_weights
from pp_cl.layers.gate import gate_backward, gate_forward
from pp_cl.layers.output import output_backward, output_forward, residual_backward
from pp_cl.layers.resample import (
    avgpool2_backward,
    avgpool2_forward,
    upsample2_backward,
    upsample2_forward,
)
from pp_cl.layers.tiles import SIDE
from pp_cl.network.layers import convolutions, gradient_of, parameter_table, unet_layers
from pp_cl.network.tile_plan import ForwardPlan, ImagePlan, ShownPlan, receptive_radius
from pp_cl.network.workspace import Workspace, WorkspacePlan
from pp_cl.settings import NetworkConfig

# Background tiles are skipped only in images of at least LEAST_PIXELS pixels, and only if at most
# MOST_COMPUTED of the multiplications remain: finding them costs time too.
LEAST_PIXELS, MOST_COMPUTED = 1 << 16, 0.8
MULTIPLE = 4  # pixels: two poolings halve the height and the width


class UNet:
    """The network, its parameters and gradients, and the buffers it works in.

    widths: channels of the three levels. blocks: what a level computes, of layers.BLOCKS.
    channels: as unet_layers() takes them.
    policy: which variants its convolutions take, None = as shipped, whatever their error. layers:
    in the order of the forward pass. parameters, gradients: {"enc0.a.weight":
    (ceil(CO/16), K, K, CI, 16), "enc0.a.bias": (ceil(CO/16) * 16,), ...} float32 on the device.
    Weights and biases start uniform in +-1/sqrt(CI K K) (PyTorch's default for Conv2d), output
    channels beyond CO at 0, with gradient 0.
    """

    def __init__(
        self,
        dev: Device,
        widths: tuple[int, int, int] = (16, 32, 64),
        channels_in: int = 16,
        channels_out: int = 3,
        *,
        blocks: str = "double",
        channels: Sequence[int] = (),
        seed: int = 0,
        policy: ConvolutionPolicy | None = None,
    ):
        self.dev = dev
        self._residual = False
        self.layers = unet_layers(widths, channels_in, channels_out, blocks, channels=channels)
        self.channels_in = channels_in
        self.policy = policy or make_policy(dev)
        self.parameters = {}
        rng = np.random.default_rng(seed)
        for layer in convolutions(self.layers):
            shape = layer.weight_shape()
            bound = 1 / np.sqrt(math.prod(shape[1:]))
            weight, bias = rng.uniform(-bound, bound, shape), rng.uniform(-bound, bound, shape[0])
            self.parameters[layer.name + ".weight"] = dev.upload(pack_weights(weight))
            self.parameters[layer.name + ".bias"] = dev.upload(pack_bias(bias))
        table = parameter_table(self.layers)
        self.gradients = {name: dev.zeros(*row) for name, row in table.items()}
        self._relu_outputs = {layer.name for layer in self.layers if layer.relu}
        self._plans = {}  # {(policy, size, training): WorkspacePlan}
        self._workspaces = {}  # {training: Workspace}
        self._trained = None  # (workspace, arrays, tile plan) of the last forward(training=True)
        self._frozen = None  # {(layer, module): weights} once frozen

    @classmethod
    def of_settings(
        cls, dev: Device, settings: NetworkConfig, policy: ConvolutionPolicy, *, seed: int = 0
    ) -> "UNet":
        """The network of a run."""
        net = cls(
            dev,
            settings.widths,
            blocks=settings.blocks,
            channels=settings.channel_numbers,
            seed=seed,
            policy=policy,
        )
        if settings.residual:
            net.connect_residual()
        return net

    def connect_residual(self) -> None:
        """From the next image on, add output.SHARE of the first three features to it."""
        self._residual = True

    def use(self, policy: ConvolutionPolicy) -> None:
        """Take the variants of another policy from the next image on."""
        self.policy = policy

    def freeze(self) -> None:
        """From now on the parameters do not change: their weights are transformed for the kernels
        once, not for each image, and training is refused.
        """
        self._frozen = {}
        self._workspaces.clear()

    @staticmethod
    def is_planned(size: tuple[int, int]) -> bool:
        """Whether plan_tiles() is worth a try for an image of size (height, width)."""
        return math.prod(size) >= LEAST_PIXELS

    def plan_tiles(
        self, size: tuple[int, int], active: np.ndarray, differs: np.ndarray | None = None
    ) -> ForwardPlan | None:
        """Which tiles to compute for features of `size` = (height, width) that are the same in all
        tiles but the `active` ones, (rows, columns) bool; None = all, as few would be saved.

        Where the network sees only this background, one tile is computed in place of many equal
        ones (tile_plan.py). The result is the same. differs: the tiles whose gradient of the
        image may not be that of others which see only background; None: all. Valid until the next
        plan.
        """
        if not self.is_planned(size):
            return None
        plan = ForwardPlan(self.dev, self.layers, size, active, differs=differs)
        return plan.upload() if plan.computed_fraction <= MOST_COMPUTED else None

    @property
    def shown_margin(self) -> int:
        """How far from what is not background, in pixels, anything matters to plan_shown()."""
        radius = receptive_radius(self.layers)[self.layers[-1].name]
        return radius + SIDE

    def plan_shown(self, size: tuple[int, int], active: np.ndarray) -> ShownPlan:
        """What to compute for the `active` tiles, (rows, columns) bool, of an image of `size` =
        (height, width); the image is undefined elsewhere. Valid until the next plan.
        """
        return ShownPlan(self.dev, self.layers, size, active).upload()

    def forward(self, x: Array, training: bool = True, plan: ImagePlan | None = None) -> Array:
        """(H, W, 3) image of the features x (H, W, channels_in); H and W are multiples of 4.

        The result is in a buffer of the network: the next call overwrites it. training: keep what
        backward needs. plan: of plan_tiles(), or of plan_shown() where nothing is trained,
        None = compute all tiles. Raises ValueError for other sizes, RuntimeError for training once
        frozen.
        """
        if training and self._frozen is not None:
            raise RuntimeError("UNet.freeze() was called: the network can no longer be trained")
        height, width, channels = x.shape
        if height % MULTIPLE or width % MULTIPLE or channels != self.channels_in:
            raise ValueError(
                f"the network takes (4n, 4m, {self.channels_in}) features, not {x.shape}"
            )
        workspace = self._workspace((height, width), training)
        arrays = workspace.arrays | {"x": x}
        tiles = plan or workspace.all_tiles
        for layer in self.layers:
            sources, out = tuple(arrays[name] for name in layer.inputs), arrays[layer.name]
            self._forward(workspace, layer, sources, out, tiles.tiles(layer.name))
            tiles.fill_copies(layer.name, out)
        output_forward(self.dev, out, x if self._residual else None)
        if training:
            self._trained = workspace, arrays, tiles
        return out

    def backward(self, grad_y: Array) -> Array:
        """(H, W, channels_in) gradient of x in the last forward(x, training=True), given dL/dy (H,
        W, 3).

        Overwrites the gradients of all parameters; parameters and x must be as they were in
        forward. The result is in a buffer of the network. Raises RuntimeError without such a
        forward.
        """
        if self._trained is None:
            raise RuntimeError("UNet.backward needs a forward(training=True) before it")
        (workspace, arrays, tiles), self._trained = self._trained, None
        grad_last = arrays[gradient_of(self.layers[-1].name)]
        output_backward(self.dev, grad_y, grad_last)
        tiles = tiles.backward(arrays)
        for layer in reversed(self.layers):
            sources = tuple(arrays[name] for name in layer.inputs)
            grad_out = arrays[gradient_of(layer.name)]
            tiles.fill_copies(layer.name, grad_out)
            if layer.kind == "conv":
                self._backward_weights(workspace, layer, sources, grad_out, tiles.tiles(layer.name))
            for i, name in enumerate(layer.inputs):
                grad_x = arrays[gradient_of(name)]
                mask = sources[i] if name in self._relu_outputs else None
                if layer.kind == "conv":
                    self._backward_input(
                        workspace, layer, i, grad_out, grad_x, mask=mask, tiles=tiles.tiles(name)
                    )
                elif layer.kind == "gate":
                    gate_backward(self.dev, sources[i], grad_out, grad_x, tiles=tiles.tiles(name))
                elif layer.kind == "pool":  # adds to the gradient of the skip
                    avgpool2_backward(self.dev, mask, grad_out, grad_x, tiles=tiles.tiles(name))
                else:
                    upsample2_backward(self.dev, grad_out, grad_x, tiles=tiles.tiles(name))
        grad_x = arrays[gradient_of("x")]
        tiles.fill_copies("x", grad_x)
        if self._residual:
            residual_backward(self.dev, grad_y, grad_x)
        return grad_x

    def _forward(self, workspace, layer, sources, out, tiles):
        """Compute the tiles of a layer's output from its inputs."""
        if layer.kind == "gate":
            gate_forward(self.dev, sources[0], out, tiles=tiles)
        elif layer.kind == "pool":
            avgpool2_forward(self.dev, sources[0], out, tiles=tiles)
        elif layer.kind == "upsample":
            upsample2_forward(self.dev, sources[0], out, tiles=tiles)
        else:
            conv = workspace.plan.convolutions[layer.name, Direction.FORWARD, None]
            conv.forward(
                self.dev,
                workspace.plan.blocking,
                sources,
                self.parameters[layer.name + ".weight"],
                self.parameters[layer.name + ".bias"],
                out,
                relu=layer.relu,
                work=workspace.work,
                tiles=tiles,
                laid_out=self._laid_out(workspace, layer, conv),
            )

    def _backward_input(self, workspace, layer, source, grad_out, grad_x, *, mask, tiles):
        """Compute the tiles of grad_x, the gradient of a convolution's input of number `source`."""
        workspace.plan.convolutions[layer.name, Direction.BACKWARD_INPUT, source].backward_input(
            self.dev,
            workspace.plan.blocking,
            self.parameters[layer.name + ".weight"],
            sum(layer.sources[:source]),
            grad_out,
            grad_x,
            mask=mask,
            work=workspace.work,
            tiles=tiles,
        )

    def _backward_weights(self, workspace, layer, sources, grad_out, tiles):
        """Overwrite the gradients of a convolution's parameters."""
        workspace.plan.convolutions[layer.name, Direction.BACKWARD_WEIGHTS, None].backward_weights(
            self.dev,
            workspace.plan.blocking,
            sources,
            grad_out,
            self.gradients[layer.name + ".weight"],
            self.gradients[layer.name + ".bias"],
            work=workspace.work,
            tiles=tiles,
        )

    def _laid_out(self, workspace, layer, conv):
        """The weights as conv.forward() transforms them, once frozen; None = not in advance."""
        if self._frozen is None:
            return None
        if (layer.name, conv) not in self._frozen:
            weight = self.parameters[layer.name + ".weight"]
            self._frozen[layer.name, conv] = conv.lay_out(self.dev, workspace.plan.blocking, weight)
        return self._frozen[layer.name, conv]

    def output(self, name: str) -> Array:
        """(H, W, C) output of the layer `name` in the last forward(training=True), until its
        backward pass.
        """
        return self._trained[1][name]

    def memory_plan(self, height: int, width: int, training: bool) -> list[tuple[str, tuple, int]]:
        """[(name, shape, bytes)] of all device buffers of this network once it has run at this
        size.

        Gradients of parameters are among them without training too: they are made with the network.
        Raises UserError where no variant is as exact as the policy's tolerance.
        """
        parameters = parameter_table(self.layers)
        table = self._plan((height, width), training).buffers() | parameters
        table |= {gradient_of(name): row for name, row in parameters.items()}
        return [
            (name, shape, math.prod(shape) * np.dtype(dtype).itemsize)
            for name, (shape, dtype) in table.items()
        ]

    def _plan(self, size, training):
        key = self.policy, size, training
        if key not in self._plans:
            self._plans[key] = WorkspacePlan(
                self.dev, self.layers, size, training, policy=self.policy
            )
        return self._plans[key]

    def _workspace(self, size, training):
        """The buffers for this size."""
        if training not in self._workspaces:
            self._workspaces[training] = Workspace(self.dev)
        workspace, plan = self._workspaces[training], self._plan(size, training)
        if training and plan is not workspace.plan:
            self._trained = None
        workspace.follow(plan)
        return workspace
