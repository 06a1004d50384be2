"""The U-Net on a device: its parameters and feature maps, and its forward and backward pass, which
launch the kernels layer by layer.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import PackedArrays, Table, packed_arrays, packed_bytes
from pp_cl.device.device import Device
from pp_cl.layers.choice import AUTO, VARIANTS, blocking_of, choose, lay_out_forward
from pp_cl.layers.conv_direct import (
    FLIPPED,
    PARTIAL,
    Direction,
    pack_bias,
    pack_weights,
    sum_parts,
    table_of_sums,
)
from pp_cl.layers.conv_winograd import TRANSFORMED
from pp_cl.layers.simple import (
    avgpool2_backward,
    avgpool2_forward,
    gate_backward,
    gate_forward,
    output_backward,
    output_forward,
    residual_backward,
    upsample2_backward,
    upsample2_forward,
)
from pp_cl.layers.tiles import all_tiles_buffers
from pp_cl.network.layers import (
    Layer,
    array_shapes,
    computations,
    convolutions,
    gradient_of,
    levels_of,
    lifetimes,
    parameter_table,
    share_buffers,
    unet_layers,
)
from pp_cl.network.tile_plan import AllTiles, ForwardPlan
from pp_cl.settings import NetworkConfig

# Background tiles are skipped only in images of at least LEAST_PIXELS pixels, and only if at most
# MOST_COMPUTED of the multiplications remain: finding them costs time too.
LEAST_PIXELS, MOST_COMPUTED = 1 << 16, 0.8
PARAMETERS = "parameters", "gradients of parameters"  # in the memory plan
MULTIPLE = 4  # pixels: two poolings halve the height and the width


class FeatureMaps:
    """The outputs of a network's layers and their gradients, for images of one size at a time.

    training: with the backward pass. size: (height, width). arrays: {name: array}, gradients by
    gradient_of(name), without x; some share a buffer, one after the other.
    """

    def __init__(self, dev: Device, layers: list[Layer], training: bool):
        self.dev, self.layers, self.training = dev, layers, training
        self.size = (0, 0)  # (height, width)
        self.arrays: dict[str, Array] = {}
        self._buffers: list[Any] = []
        self._all_tiles: AllTiles | None = None

    def resize(self, size: tuple[int, int]) -> None:
        """Make room for images of this size, in the same buffers where they are large enough:
        images of a film differ in size. The arrays are undefined then.
        """
        if size == self.size:
            return
        self.size, self.arrays, self._all_tiles = (0, 0), {}, None
        shapes = array_shapes(self.layers, size)
        shared = share_buffers(lifetimes(self.layers, self.training), shapes)
        self._buffers += [None] * (len(shared) - len(self._buffers))
        for i, buffer in enumerate(shared):
            if self._buffers[i] is None or self._buffers[i].size < buffer.floats:
                self._buffers[i] = None  # frees the old one first
                self._buffers[i] = self.dev.empty((buffer.floats,))
            for name in buffer.names:
                floats = math.prod(shapes[name])
                self.arrays[name] = self._buffers[i][:floats].reshape(shapes[name])
        self.size = size

    @property
    def all_tiles(self) -> AllTiles:
        """Of an image of this size."""
        if self._all_tiles is None:
            self._all_tiles = AllTiles(self.dev, self.size, self.layers)
        return self._all_tiles


class UNet:
    """The network, its parameters and gradients, and the buffers it works in.

    widths: channels of the three levels. blocks: what a level computes, of layers.BLOCKS. channels:
    as unet_layers() takes them. residual: adds output.SHARE of the first three features to the
    image. variant: of the convolutions, as choose() takes it; blocking: of their kernels, as
    shipped for the device. layers: in the order of the forward pass. parameters, gradients:
    {"enc0.a.weight": (ceil(CO/16), K, K, CI, 16), "enc0.a.bias": (ceil(CO/16) * 16,), ...} float32
    on the device; all_parameters, all_gradients: the 1-D array that they lie in, with zeros between
    them. Weights and biases start uniform in +-1/sqrt(CI K K) (PyTorch's
    default for Conv2d), output channels beyond CO at 0, with gradient 0.
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
        residual: bool = False,
        seed: int = 0,
        variant: str = AUTO,
    ):
        self.dev = dev
        self._residual = residual
        self.layers = unet_layers(widths, channels_in, channels_out, blocks, channels=channels)
        self.channels_in = channels_in
        self.variant, self.blocking = variant, blocking_of(dev)
        self.all_parameters, self.parameters = self._packed()
        self.all_gradients, self.gradients = self._packed()
        rng = np.random.default_rng(seed)
        for layer in convolutions(self.layers):
            shape = layer.weight_shape()
            bound = 1 / np.sqrt(math.prod(shape[1:]))
            weight, bias = rng.uniform(-bound, bound, shape), rng.uniform(-bound, bound, shape[0])
            dev.write(self.parameters[layer.name + ".weight"], pack_weights(weight))
            dev.write(self.parameters[layer.name + ".bias"], pack_bias(bias))
        self._relu_outputs = {layer.name for layer in self.layers if layer.relu}
        self._maps: dict[bool, FeatureMaps] = {}  # {training: FeatureMaps}
        # {(variant, layer, direction, source, size): module of a convolution}
        self._modules: dict[Any, Any] = {}
        self._tile_lists = {name: PackedArrays(dev) for name in ("forward", "backward")}
        self._trained: Any = None  # (size, arrays, tiles) of the last forward(training=True)
        self._frozen: dict[Any, Array] | None = None  # {(layer, module): weights} once frozen
        self._planned: Any = (None,)  # of the last training pass: (variant, size), _plan()
        self._work: dict[Any, Any] = {}  # of the last pass: arrays of _plan(), if for training
        self._sums = PackedArrays(dev)
        self._sum_rows: Any = None
        self._sum_table: Any = None

    @classmethod
    def of_settings(cls, dev: Device, settings: NetworkConfig, *, seed: int = 0) -> "UNet":
        """The network of a run."""
        return cls(
            dev,
            settings.widths,
            blocks=settings.blocks,
            channels=settings.channel_numbers,
            residual=settings.residual,
            seed=seed,
        )

    def _packed(self):
        """(zeros like all_parameters, {name: array in them}) of the parameters."""
        table = parameter_table(self.layers)
        whole, arrays = packed_arrays(self.dev, [*table.values()])
        return whole.view(np.float32), dict(zip(table, arrays, strict=True))

    def split(self, whole: Array) -> dict[str, Array]:
        """{name of a parameter: its part of an array that is laid out as all_parameters}."""
        parts = {}
        for name, parameter in self.parameters.items():
            start = parameter.base_data.offset // parameter.dtype.itemsize
            parts[name] = whole[start : start + parameter.size].reshape(parameter.shape)
        return parts

    def freeze(self) -> None:
        """From now on the parameters do not change: their weights are transformed for the kernels
        once, not for each image, and training is refused.
        """
        self._frozen = {}
        self._maps.clear()

    @staticmethod
    def is_planned(size: tuple[int, int]) -> bool:
        """Whether plan_tiles() is worth a try for an image of size (height, width)."""
        return math.prod(size) >= LEAST_PIXELS

    def plan_tiles(
        self, size: tuple[int, int], active: np.ndarray, gradient_tiles: np.ndarray | None = None
    ) -> ForwardPlan | None:
        """Which tiles to compute for features of `size` = (height, width) that are the same in all
        tiles but the `active` ones, (rows, columns) bool; None = all, as few would be saved.

        Where the network sees only this background, one tile is computed in place of many equal
        ones (tile_plan.py). The result is the same. gradient_tiles: (rows, columns) bool, the tiles
        where dL/dimage may differ from that of other background tiles, for the backward pass; None:
        all. Valid until the next plan.
        """
        if not self.is_planned(size):
            return None
        plan = ForwardPlan(self.dev, self.layers, size, active, gradient_tiles=gradient_tiles)
        if plan.computed_fraction > MOST_COMPUTED:
            return None
        plan.upload(self._tile_lists["forward"], plan.maps)
        return plan

    def forward(self, x: Array, training: bool = True, plan: ForwardPlan | None = None) -> Array:
        """(H, W, 3) image of the features x (H, W, channels_in); H and W are multiples of 4.

        The result is in a buffer of the network: the next call overwrites it. training: keep what
        backward needs. plan: of plan_tiles(), None = compute all tiles. Raises ValueError for other
        sizes, RuntimeError for training once frozen.
        """
        if training and self._frozen is not None:
            raise RuntimeError("UNet.freeze() was called: the network can no longer be trained")
        height, width, channels = x.shape
        if height % MULTIPLE or width % MULTIPLE or channels != self.channels_in:
            raise ValueError(
                f"the network takes (4n, 4m, {self.channels_in}) features, not {x.shape}"
            )
        if training not in self._maps:
            self._maps[training] = FeatureMaps(self.dev, self.layers, training)
        if training:
            self._trained = None  # its arrays are overwritten
        maps, size = self._maps[training], (height, width)
        maps.resize(size)
        arrays = maps.arrays | {"x": x}
        tiles = plan or maps.all_tiles
        self._prepare(size if training else None)
        for layer in self.layers:
            sources, out = tuple(arrays[name] for name in layer.inputs), arrays[layer.name]
            self._forward(size, layer, sources, out, tiles.tiles(layer.name))
            tiles.fill_copies(layer.name, out)
        output_forward(self.dev, out, x if self._residual else None)
        if training:
            self._trained = size, arrays, tiles
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
        (size, arrays, tiles), self._trained = self._trained, None
        _, self._work, _, _ = self._planned
        output_backward(self.dev, grad_y, arrays[gradient_of(self.layers[-1].name)])
        tiles, sums = tiles.backward(arrays, self._tile_lists["backward"]), []
        for layer in reversed(self.layers):
            grad = gradient_of(layer.name)
            tiles.fill_copies(grad, arrays[grad])
            if layer.kind == "conv":
                sums.append(self._backward_weights(size, layer, arrays, tiles.tiles(grad)))
            for i, name in enumerate(layer.inputs):
                self._backward_input(size, layer, i, arrays, tiles.tiles(gradient_of(name)))
        grad_x = arrays[gradient_of("x")]
        tiles.fill_copies(gradient_of("x"), grad_x)
        if self._residual:
            residual_backward(self.dev, grad_y, grad_x)
        self._sum_parts(sums)
        return grad_x

    def _forward(self, size, layer, sources, out, tiles):
        """Compute the tiles of a layer's output from its inputs."""
        if layer.kind == "gate":
            gate_forward(self.dev, sources[0], out, tiles=tiles)
        elif layer.kind == "pool":
            avgpool2_forward(self.dev, sources[0], out, tiles=tiles)
        elif layer.kind == "upsample":
            upsample2_forward(self.dev, sources[0], out, tiles=tiles)
        else:
            module = self._module(layer, Direction.FORWARD, None, size)
            module.forward(
                self.dev,
                self.blocking,
                sources,
                self.parameters[layer.name + ".weight"],
                self.parameters[layer.name + ".bias"],
                out,
                relu=layer.relu,
                tiles=tiles,
                laid_out=self._laid_out(layer, module),
            )

    def _backward_input(self, size, layer, source, arrays, tiles):
        """Compute the tiles of the gradient of a layer's input of number `source`."""
        name = layer.inputs[source]
        x, grad_x = arrays[name], arrays[gradient_of(name)]
        grad_out = arrays[gradient_of(layer.name)]
        mask = x if name in self._relu_outputs else None
        if layer.kind == "gate":
            gate_backward(self.dev, x, grad_out, grad_x, tiles=tiles)
        elif layer.kind == "pool":  # adds to the gradient of the skip
            avgpool2_backward(self.dev, mask, grad_out, grad_x, tiles=tiles)
        elif layer.kind == "upsample":
            upsample2_backward(self.dev, grad_out, grad_x, tiles=tiles)
        else:
            self._module(layer, Direction.BACKWARD_INPUT, source, size).backward_input(
                self.dev,
                self.blocking,
                self.parameters[layer.name + ".weight"],
                sum(layer.sources[:source]),
                grad_out,
                grad_x,
                mask=mask,
                tiles=tiles,
                laid_out=self._work.get((layer.name, source)),
            )

    def _backward_weights(self, size, layer, arrays, tiles):
        """Leave the gradients of a convolution's parameters in parts; returns what sums them."""
        weight, bias = (self.gradients[f"{layer.name}.{kind}"] for kind in ("weight", "bias"))
        partial = self._work[layer.name, PARTIAL]
        parts = self._module(layer, Direction.BACKWARD_WEIGHTS, None, size).backward_weights(
            self.dev,
            self.blocking,
            tuple(arrays[name] for name in layer.inputs),
            arrays[gradient_of(layer.name)],
            weight.shape,
            partial,
            tiles=tiles,
        )
        return weight.shape, parts, *(a.base_data.offset // 4 for a in (partial, weight, bias))

    def _sum_parts(self, sums):
        """Overwrite the gradients of all parameters; sums: of _backward_weights()."""
        rows, n = table_of_sums(sums)
        if rows != self._sum_rows:
            self._sum_rows = rows
            shape = (len(rows), 8), np.int32
            [self._sum_table] = self._sums.send([shape], [np.array(rows, np.int32)])
        _, _, whole, _ = self._planned
        sum_parts(self.dev, self._sum_table, n, whole, self.all_gradients, self.all_gradients)

    def _module(self, layer, direction, source, size):
        """The module that computes a convolution in an image of a size."""
        key = self.variant, layer.name, direction, source, size
        if key not in self._modules:
            shape = layer.shape(direction, source, *size)
            self._modules[key] = VARIANTS[choose(self.dev, shape, self.variant)]
        return self._modules[key]

    def _laid_out(self, layer, module):
        """The weights in the module's own layout: of this training pass, or made once after
        freeze(); else None.
        """
        if self._frozen is None:
            return self._work.get((layer.name, None))
        key = layer.name, module
        if key not in self._frozen:
            weight = self.parameters[layer.name + ".weight"]
            self._frozen[key] = lay_out_forward(self.dev, module, weight)
        return self._frozen[key]

    def _prepare(self, size):
        """Set what a training pass over images of `size` works with, None: another pass; and lay
        out all weights, in a launch for each kind of layout.
        """
        self._work = {}
        if size is None:
            return
        if self._planned[0] != (self.variant, size):
            self._planned = (None,)  # frees the old arrays first
            self._planned = (self.variant, size), *self._plan(size)
        _, self._work, whole, jobs = self._planned
        for lay_out, of_layers in jobs.items():
            lay_out(self.dev, self.all_parameters, of_layers, whole)

    def _plan(self, size):
        """({(layer, input, None or PARTIAL): array}, the one that they lie in, {lay_out(): jobs}):
        of the weights as passes read them, and of the parts of their gradients.
        """
        table = self._work_table(size)
        whole, arrays = packed_arrays(self.dev, [row for _, row in table.values()])
        jobs = defaultdict(list)
        for ((layer, source), (module, _)), array in zip(table.items(), arrays, strict=True):
            if source == PARTIAL:
                continue
            weight = self.parameters[layer.name + ".weight"]
            first = None if source is None else sum(layer.sources[:source])
            c = sum(layer.sources) if source is None else layer.sources[source]
            start, target = (part.base_data.offset // 4 for part in (weight, array))
            jobs[module.lay_out].append((start, target, weight.shape, first, c, layer.channels))
        work = {(layer.name, i): a for (layer, i), a in zip(table, arrays, strict=True)}
        return work, whole.view(np.float32), jobs

    def _work_table(self, size):
        """{(layer, input, None or PARTIAL): (module, (shape, dtype))} of the arrays of _plan()."""
        table = {}
        for layer in convolutions(self.layers):
            shape = self.parameters[layer.name + ".weight"].shape
            for direction, source in computations(layer, True):
                module = self._module(layer, direction, source, size)
                c = layer.shape(direction, source, *size).ci
                if direction is Direction.BACKWARD_WEIGHTS:
                    height, source = size[0] >> layer.level, PARTIAL
                    scratch = module.scratch_floats(
                        self.dev, self.blocking, direction, height, shape, c
                    )
                    floats = scratch[PARTIAL]
                else:
                    floats = module.laid_out_floats(direction, shape, c)
                if floats:
                    table[layer, source] = module, ((floats,), np.float32)
        return table

    def output(self, name: str) -> Array:
        """(H, W, C) output of the layer `name` in the last forward(training=True), until its
        backward pass.
        """
        return self._trained[1][name]

    def memory_plan(self, height: int, width: int, training: bool) -> Table:
        """All device buffers of this network once it has run at this size, what its convolutions
        share with others among them.

        Gradients of parameters are among them without training too: they are made with the network.
        """
        size = (height, width)
        shared = share_buffers(lifetimes(self.layers, training), array_shapes(self.layers, size))
        floats = {" = ".join(buffer.names): buffer.floats for buffer in shared}
        for layer in convolutions(self.layers):
            weight_shape = self.parameters[layer.name + ".weight"].shape
            for direction, source in computations(layer, training):
                needed = self._module(layer, direction, source, size).scratch_floats(
                    self.dev,
                    self.blocking,
                    direction,
                    height >> layer.level,
                    weight_shape,
                    layer.shape(direction, source, *size).ci,
                )
                for name, number in needed.items():
                    if not training or name not in (FLIPPED, PARTIAL, TRANSFORMED):  # of _plan()
                        floats[name] = max(number, floats.get(name, 0))
        table: Table = {name: ((number,), np.float32) for name, number in floats.items()}
        table |= dict.fromkeys(PARAMETERS, (self.all_parameters.shape, np.float32))
        if training:
            rows = [row for _, row in self._work_table(size).values()]
            sums = (len(convolutions(self.layers)), 8), np.int32
            for name, packed in (("laid out", rows), ("sums of gradients", [sums])):
                table[name] = (packed_bytes(self.dev, packed),), np.uint8
        for level in set(levels_of(self.layers).values()):
            tiles = all_tiles_buffers(height >> level, width >> level)
            table |= {f"tiles of level {level}, {name}": row for name, row in tiles.items()}
        return table
