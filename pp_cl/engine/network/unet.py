"""Networks on a device, mainly the U-Net: parameters, and the forward and the backward pass."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import PackedArrays, Pending, Table, packed_arrays, table_bytes
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import replayed
from pp_cl.engine.layers.choice import AUTO, VARIANTS, blocking_of, choose, lay_out, work_table
from pp_cl.engine.layers.conv import (
    DIRECTIONS,
    Conv,
    ConvShape,
    GradientParts,
    first_float,
    gradient_parts,
    pack_bias,
    pack_weights,
    sum_parts,
)
from pp_cl.engine.layers.conv_winograd import reserve_scratch, scratch_floats
from pp_cl.engine.layers.simple import (
    avgpool2_backward,
    avgpool2_forward,
    gate_backward,
    gate_forward,
    output_forward,
    residual_backward,
    upsample2_backward,
    upsample2_forward,
)
from pp_cl.engine.layers.tiles import tiles_find, tiles_with
from pp_cl.engine.network.layers import (
    Layer,
    array_shapes,
    convolutions,
    gradient_of,
    lifetimes,
    parameter_table,
    share_buffers,
    unet_layers,
)
from pp_cl.engine.network.tile_plan import (
    TilePlan,
    plan_all,
    plan_backward,
    plan_forward,
    tiles_in_reach,
)
from pp_cl.settings import NetworkConfig

# Background tiles are skipped only in images of at least LEAST_PIXELS pixels (LEAST_FROZEN if the
# network is frozen), and only if at most MOST_COMPUTED of the multiplications remain, because
# finding them takes time too. This saves a tenth of the demo's frame time at 200x200, nothing at
# 128x128.
LEAST_PIXELS, LEAST_FROZEN, MOST_COMPUTED = 1 << 16, 1 << 15, 0.8
WHITE = 1.0  # colour of a target where its image is transparent
SIMPLE = {"gate": gate_forward, "pool": avgpool2_forward, "upsample": upsample2_forward}

Size = tuple[int, int]  # (height, width)
Convs = dict[tuple[str, str], Conv]  # {(layer, direction): Conv}


class Workspace:
    """The arrays of the forward pass over images of one size, or of both passes.

    size: (height, width) of the images. arrays: {name: feature map}, gradients by
    gradient_of(name), without "x", which the caller owns; some share a buffer in turn. convs: the
    convolutions; their arrays lie in `work`. all_tiles: the plan that skips nothing. is_laid_out:
    whether `work` holds the network's present weights. calls: recorded calls of replayed()
    functions, which keep the caller's arrays alive.
    """

    def __init__(self, dev: Device) -> None:
        self.dev = dev
        self.calls: dict[Any, Any] = {}
        self.size: Size = (0, 0)
        self.arrays: dict[str, Array] = {}
        self.convs: Convs = {}
        self.work: Any = None
        self.all_tiles: Any = None
        self.is_laid_out = False
        self._buffers: list[Any] = []
        self.part_table = PackedArrays(dev)

    def plan(self, net: "Network", size: Size, training: bool) -> None:
        """Make room for images of this size, reusing buffers that are large enough. The arrays are
        undefined afterwards.
        """
        self.size, self.is_laid_out = (0, 0), False
        # frees the old arrays first
        self.arrays, self.convs, self.work, self.all_tiles = {}, {}, None, None
        self.calls.clear()
        maps = array_shapes(net.layers, size)
        shared = share_buffers(lifetimes(net.layers, training), maps)
        self._buffers += [None] * (len(shared) - len(self._buffers))
        for i, buffer in enumerate(shared):
            if self._buffers[i] is None or self._buffers[i].size < buffer.floats:
                self._buffers[i] = None  # frees the old one first
                self._buffers[i] = net.dev.empty((buffer.floats,))
            for name in buffer.names:
                floats = math.prod(maps[name])
                self.arrays[name] = self._buffers[i][:floats].reshape(maps[name])
        self.convs = net.convolutions(size, training)
        needed = _work_rows(self.convs)
        whole, arrays = packed_arrays(net.dev, [*needed.values()])
        self.work = whole.view(np.float32)
        for (key, name), array in zip(needed, arrays, strict=True):
            self.convs[key].take(name, array)
        reserve_scratch(self.convs.values())
        self.all_tiles = plan_all(net.dev, net.layers, size)
        self.size = size


def _work_rows(convs):
    """{(key, name): (shape, dtype)} of the arrays that convolutions need besides a layer's own."""
    return {
        (key, name): row
        for key, conv in convs.items()
        for name, row in work_table(conv.variant, conv.shape).items()
    }


class Network:
    """A network of layers, its parameters and gradients, and its buffers.

    layers: in the order of the forward pass; the image is 0.5 + 0.5 times the output of the last
    one. residual: adds simple.SHARE of the first three features to the image. variant: how choose()
    selects the convolutions; blocking: the sizes of their kernels, shipped for the device; both may
    be replaced before the first pass. parameters: {"enc0.a.weight": (ceil(CO/16), K, K, CI, 16),
    "enc0.a.bias": (ceil(CO/16) * 16,), ...} float32 on the device; all_parameters: the 1-D array
    that contains them, with zeros between them. Weights and biases start uniform in +-1/sqrt(CI K
    K) (PyTorch's default for Conv2d), output channels beyond CO at 0, with gradient 0. multiple:
    image width and height must be multiples of this, in pixels.
    """

    multiple = 4  # two poolings of the U-Net halve the height and the width

    def __init__(
        self,
        dev: Device,
        layers: list[Layer],
        *,
        residual: bool = False,
        seed: int = 0,
        variant: str = AUTO,
    ):
        self.dev = dev
        self._residual = residual
        self.layers = layers
        self.variant, self.blocking = variant, blocking_of(dev)
        self.all_parameters, self.parameters = self._packed()
        self._gradients: Any = None  # for sum_gradients(): (whole array, {name: its part})
        self.reset(seed)
        self.relu_outputs = {layer.name for layer in self.layers if layer.relu}
        self._workspaces: dict[bool, Workspace] = {}  # {training: Workspace}
        self._tile_lists = {name: PackedArrays(dev) for name in ("forward", "backward")}
        # (plan, x) of the last forward(training=True), until its backward()
        self._trained: Any = None
        self._is_frozen = False

    def reset(self, seed: int) -> None:
        """Write the initial parameters of a training."""
        rng = np.random.default_rng(seed)
        for layer in convolutions(self.layers):
            shape = layer.weight_shape()
            bound = 1 / np.sqrt(math.prod(shape[1:]))
            weight, bias = rng.uniform(-bound, bound, shape), rng.uniform(-bound, bound, shape[0])
            self.dev.write(self.parameters[layer.name + ".weight"], pack_weights(weight))
            self.dev.write(self.parameters[layer.name + ".bias"], pack_bias(bias))

    def _packed(self):
        """(zeros like all_parameters, {name: the part of them that holds a parameter})."""
        table = parameter_table(self.layers)
        whole, arrays = packed_arrays(self.dev, [*table.values()])
        return whole.view(np.float32), dict(zip(table, arrays, strict=True))

    def split(self, whole: Array) -> dict[str, Array]:
        """{name of a parameter: its part of `whole`, an array laid out like all_parameters}."""
        parts = {}
        for name, parameter in self.parameters.items():
            start = first_float(parameter)
            parts[name] = whole[start : start + parameter.size].reshape(parameter.shape)
        return parts

    def release(self) -> None:
        """Stop holding the arrays of past passes."""
        for space in self._workspaces.values():
            space.calls.clear()

    def freeze(self) -> None:
        """Declare that the parameters no longer change: their weights are laid out for the kernels
        once, not for each image, and training is refused.
        """
        self._is_frozen = True
        self._workspaces.clear()

    def is_planned(self, size: tuple[int, int]) -> bool:
        """Whether plan_tiles() is worth trying for an image of size (height, width)."""
        return math.prod(size) >= (LEAST_FROZEN if self._is_frozen else LEAST_PIXELS)

    def plan_tiles(
        self, size: tuple[int, int], active: np.ndarray, gradient_tiles: np.ndarray | None = None
    ) -> TilePlan | None:
        """Plan which tiles to compute for features of `size` = (height, width) that are equal in
        all tiles except `active`, (rows, columns) bool; None: compute all, as too few would be
        saved.

        Where the network sees only this background, one tile is computed in place of many equal
        ones (tile_plan.py). The result is the same. gradient_tiles: (rows, columns) bool, the tiles
        where dL/dimage may differ from that of other background tiles, for the backward pass; None:
        all. Valid until the next plan.
        """
        if not self.is_planned(size):
            return None
        lists = self._tile_lists["forward"]
        return plan_forward(self.layers, size, active, gradient_tiles, lists, most=MOST_COMPUTED)

    def gradient_tiles(
        self,
        target: Array,
        ignored: np.ndarray | None,
        size: tuple[int, int],
        corner: Sequence[int],
    ) -> Pending[np.ndarray] | None:
        """The argument of that name of plan_tiles() for a step with this target, (h, w, 3) float32,
        whose corner lies at (left, top) of the image of `size`; None if none is needed. Get it
        after waiting for the device anyway, so that looking at the target costs no extra wait.

        ignored: (h, w) bool, the pixels that the loss ignores, if any. They are white in the
        target, but their gradient differs from the background's.
        """
        if not self.is_planned(size):
            return None
        left, top = corner
        beside = False if ignored is None else tiles_with(ignored)

        def in_reach(tiles):
            return tiles_in_reach(tiles | beside, size, (left, top))

        return tiles_find(self.dev, target, WHITE, in_reach)

    def forward(self, x: Array, training: bool = True, plan: TilePlan | None = None) -> Array:
        """(H, W, 3) image of the features x (H, W, 16); H and W are multiples of 4.

        The result is in a buffer of the network: the next call overwrites it. training: keep what
        backward() needs. plan: from plan_tiles(), None = compute all tiles. Raises ValueError for
        other sizes, RuntimeError for training once frozen.
        """
        if training and self._is_frozen:
            raise RuntimeError("Network.freeze() was called: the network can no longer be trained")
        height, width, channels = x.shape
        taken = sum(self.layers[0].sources)
        if height % self.multiple or width % self.multiple or channels != taken:
            raise ValueError(f"the network takes (4n, 4m, {taken}) features, not {x.shape}")
        if training not in self._workspaces:
            self._workspaces[training] = Workspace(self.dev)
        space = self._workspaces[training]
        if training:
            self._trained = None  # its arrays are overwritten
        if space.size != (height, width):
            space.plan(self, (height, width), training)
        if not (self._is_frozen and space.is_laid_out):
            self._lay_out(space)
            space.is_laid_out = True
        plan = plan or space.all_tiles
        self._forward(space, plan, x)
        if training:
            self._trained = plan, x
        return space.arrays[self.layers[-1].name]

    @replayed
    def _lay_out(self, space):
        lay_out(self.dev, space.convs.values(), self.all_parameters, space.work)

    @replayed
    def _forward(self, space, plan, x):
        arrays = space.arrays | {"x": x}
        for layer in self.layers:
            sources, out = [arrays[name] for name in layer.inputs], arrays[layer.name]
            tiles = plan.tiles[layer.name]
            if layer.kind == "conv":
                conv = space.convs[layer.name, "forward"]
                variant = VARIANTS[conv.variant]
                variant.forward(conv, sources, out, relu=layer.relu, tiles=tiles)
            else:
                SIMPLE[layer.kind](self.dev, sources[0], out, tiles=tiles)
            plan.copy_tiles(self.dev, layer.name, out)
        output_forward(self.dev, out, x if self._residual else None)

    def backward(self, grad_y: Array) -> tuple[Array, GradientParts]:
        """Given dL/dy (H, W, 3), returns the gradient (H, W, 16) of x in the last forward(x,
        training=True), and the parts whose sums are the gradients of all parameters, for
        sum_gradients() or an optimiser.

        Parameters and x must be unchanged since forward(). The results are in buffers of the
        network. Raises RuntimeError without such a forward().
        """
        if self._trained is None:
            raise RuntimeError("Network.backward needs a forward(training=True) before it")
        space, (plan, x), self._trained = self._workspaces[True], self._trained, None
        if plan.maps:  # it skips tiles
            plan = plan_backward(self.layers, space.size, plan, self._tile_lists["backward"])
        parts = self._backward(space, plan, x, grad_y)
        return space.arrays[gradient_of("x")], parts

    def sum_gradients(self, parts: GradientParts) -> dict[str, Array]:
        """{name of a parameter: its gradient} from the parts of backward(), valid until the next
        call.
        """
        if self._gradients is None:
            self._gradients = self._packed()
        whole, gradients = self._gradients
        sum_parts(self.dev, parts, whole, whole)
        return gradients

    @replayed
    def _backward(self, space, plan, x, grad_y):
        dev, arrays, convs = self.dev, space.arrays | {"x": x}, space.convs
        last = self.layers[-1]
        arrays[gradient_of(last.name)] = grad_y
        for name in sorted(plan.copies.keys() - plan.tiles.keys()):  # forward outputs that are read
            plan.copy_tiles(dev, name, arrays[name])
        parts = []
        for layer in reversed(self.layers):
            grad_out = arrays[gradient_of(layer.name)]
            if layer is not last:
                plan.copy_tiles(dev, gradient_of(layer.name), grad_out)
            sources = [arrays[name] for name in layer.inputs]
            grads = [arrays[gradient_of(name)] for name in layer.inputs]
            masks = [name in self.relu_outputs for name in layer.inputs]
            tiles = plan.tiles[gradient_of(layer.inputs[0])]
            if layer.kind == "gate":
                gate_backward(dev, *sources, grad_out, *grads, tiles=tiles)
            elif layer.kind == "pool":  # adds to the gradient of the skip
                mask = sources[0] if masks[0] else None
                avgpool2_backward(dev, mask, grad_out, *grads, tiles=tiles)
            elif layer.kind == "upsample":
                upsample2_backward(dev, grad_out, *grads, tiles=tiles)
            else:
                conv = convs[layer.name, "backward"]
                count = VARIANTS[conv.variant].backward(
                    conv,
                    sources,
                    grad_out,
                    grads,
                    masks=masks,
                    tiles=plan.tiles[gradient_of(layer.name)],
                    grad_tiles=tiles,
                )
                parts.append((conv, count))
        grad_x = arrays[gradient_of("x")]
        plan.copy_tiles(dev, gradient_of("x"), grad_x)
        if self._residual:
            residual_backward(dev, grad_y, grad_x)
        return gradient_parts(parts, space.part_table, space.work)

    def output(self, name: str) -> Array:
        """(H, W, C) output of the layer `name` in the last forward(training=True), valid until its
        backward pass.
        """
        return self._workspaces[True].arrays[name]

    def convolutions(self, size: Size, training: bool) -> Convs:
        """The Conv of each convolution for images of a size, and in training also those of the
        backward pass; their own arrays are not yet allocated.
        """
        convs: Convs = {}
        for layer in convolutions(self.layers):
            here = size[0] >> layer.level, size[1] >> layer.level
            for direction in DIRECTIONS if training else ("forward",):
                of_layer = layer.kernel_size, layer.sources, layer.channels
                shape = ConvShape(direction, *of_layer, here)
                variant = choose(self.dev, shape, self.variant)
                weight, bias = (self.parameters[f"{layer.name}.{n}"] for n in ("weight", "bias"))
                is_last = layer is self.layers[-1]  # output_forward() halves its output
                conv = Conv(self.dev, self.blocking, variant, shape, weight, bias, is_last)
                convs[layer.name, direction] = conv
        return convs

    def table(self, crop: Size, image: Size) -> Table:
        """The arrays of a network that is trained on crops of one size and renders images of
        another: its parameters, the feature maps and work of both passes, and the scratch memory
        that their convolutions share, which grows with the device's compute units.
        """
        whole = self.all_parameters.shape, np.float32
        table: Table = {"parameters": whole}
        scratch = [0]
        for training, size in ((True, crop), (False, image)):
            convs, maps = self.convolutions(size, training), array_shapes(self.layers, size)
            shared = share_buffers(lifetimes(self.layers, training), maps)
            table |= {f"{training} {i}": ((b.floats,), np.float32) for i, b in enumerate(shared)}
            table[f"{training} work"] = (table_bytes(_work_rows(convs)),), np.uint8
            transformed = [conv for conv in convs.values() if conv.variant == "winograd"]
            scratch += map(scratch_floats, transformed)
        return table | {"scratch": ((max(scratch),), np.float32)}


class UNet(Network):
    """The U-Net that turns blended features into colours.

    widths: channels of the three levels. blocks: what each level computes, one of settings.BLOCKS.
    options: those of Network.
    """

    def __init__(
        self,
        dev: Device,
        widths: tuple[int, int, int] = (16, 32, 64),
        *,
        blocks: str = "double",
        **options: Any,
    ):
        super().__init__(dev, unet_layers(widths, blocks=blocks), **options)

    @classmethod
    def of_settings(cls, dev: Device, settings: NetworkConfig, *, seed: int = 0) -> "UNet":
        """The network of a run."""
        return cls(
            dev,
            settings.widths,
            blocks=settings.blocks,
            residual=settings.residual,
            seed=seed,
        )
