"""The U-Net on a device: its parameters, and its forward and its backward pass, which are lists of
launches, made once for images of one size.
"""

import math
import weakref
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import PackedArrays, Table, packed_arrays, table_bytes
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.choice import AUTO, blocking_of, choose
from pp_cl.engine.layers.conv_direct import (
    ConvShape,
    DirectConv,
    Direction,
    Layout,
    Sums,
    pack_bias,
    pack_weights,
    sum_parts,
    table_of_sums,
)
from pp_cl.engine.layers.simple import (
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
from pp_cl.engine.layers.tiles import tiles_find, tiles_with
from pp_cl.engine.network.layers import (
    array_shapes,
    convolutions,
    gradient_of,
    lifetimes,
    parameter_table,
    share_buffers,
    unet_layers,
)
from pp_cl.engine.network.tile_plan import AllTiles, ForwardPlan, gradient_tiles
from pp_cl.settings import NetworkConfig

# Background tiles are skipped only in images of at least LEAST_PIXELS pixels, and only if at most
# MOST_COMPUTED of the multiplications remain: finding them costs time too.
LEAST_PIXELS, MOST_COMPUTED = 1 << 16, 0.8
WHITE = 1.0  # of a target where its photograph is transparent

Size = tuple[int, int]  # (height, width)
# What is computed for a convolution: its layer, a direction, the input whose gradient it is.
Work = tuple[str, Direction, int | None]
Launch = tuple[Any, ...]  # a method of Pass, and its arguments before the tiles


class Pass:
    """The forward pass over images of one size, or that and the backward pass: where the arrays
    lie, and the launches in order.

    training: with the backward pass. size: of the images. arrays: {name: feature map}, gradients by
    gradient_of(name); some share a buffer, one after the other. "x", the caller's, is there while a
    pass runs. forward, backward: the launches. all_tiles: every tile of every feature map.
    """

    def __init__(self, net: "UNet", training: bool):
        # weakly: in a circle the buffers would live until the garbage collector runs
        self.net: UNet = weakref.proxy(net)
        self.training = training
        self.size: Size = (0, 0)
        self.arrays: dict[str, Array] = {}
        self.forward: list[Launch] = []
        self.backward: list[Launch] = []
        self.all_tiles: Any = None
        self.is_laid_out = False  # the weights, for the kernels
        self._buffers: list[Any] = []
        self._work: Any = None  # all of _work_table(), in one array
        self._jobs: dict[Callable, list[Layout]] = {}  # {lay_out() of a variant: what it lays out}
        self._sums: list[Sums] = []
        self._table = net.dev.empty((len(convolutions(net.layers)), 8), np.int32)

    def plan(self, size: Size) -> None:
        """Make room for images of this size, in the same buffers where they are large enough, and
        list the launches. The arrays are undefined then.
        """
        net, self.size, self.is_laid_out = self.net, (0, 0), False
        self.forward, self.backward, self.all_tiles = [], [], None  # frees the old arrays first
        self._place_feature_maps(size)
        convs, self.all_tiles = self._place_work(size), AllTiles(net.dev, size, net.layers)
        for layer in net.layers:
            conv = convs.get((layer.name, Direction.FORWARD, None))
            self.forward += [(Pass._compute, layer, conv), (Pass._copy, layer.name)]
        for layer in reversed(net.layers) if self.training else ():
            self.backward.append((Pass._copy, gradient_of(layer.name)))
            if layer.kind == "conv":
                conv = convs[layer.name, Direction.BACKWARD_WEIGHTS, None]
                self.backward.append((Pass._compute_gradient_of_weights, layer, conv))
            for i in range(len(layer.inputs)):
                conv = convs.get((layer.name, Direction.BACKWARD_INPUT, i))
                self.backward.append((Pass._compute_gradient, layer, i, conv))
        self.backward.append((Pass._copy, gradient_of("x")))
        self.size = size

    def run(self, launches: list[Launch], tiles: Any) -> None:
        """Launch `forward` or `backward`. tiles: an AllTiles or TilePlan, which says what tiles of
        each feature map to compute.
        """
        for launch, *given in launches:
            launch(self, *given, tiles)

    def _place_feature_maps(self, size):
        shapes = array_shapes(self.net.layers, size)
        shared = share_buffers(lifetimes(self.net.layers, self.training), shapes)
        self.arrays = {}
        self._buffers += [None] * (len(shared) - len(self._buffers))
        for i, buffer in enumerate(shared):
            if self._buffers[i] is None or self._buffers[i].size < buffer.floats:
                self._buffers[i] = None  # frees the old one first
                self._buffers[i] = self.net.dev.empty((buffer.floats,))
            for name in buffer.names:
                floats = math.prod(shapes[name])
                self.arrays[name] = self._buffers[i][:floats].reshape(shapes[name])

    def _place_work(self, size):
        """{Work: (what computes it, its array)}: the weights as the kernels read them, or room for
        the parts of the gradients.
        """
        convs, self._work, self._jobs = self.net.work(size, self.training), None, defaultdict(list)
        rows = _work_table(convs)
        whole, arrays = packed_arrays(self.net.dev, [*rows.values()])
        self._work, work = whole.view(np.float32), dict(zip(rows, arrays, strict=True))
        found = {}
        for key, conv in convs.items():
            weight = self.net.parameters[f"{key[0]}.weight"]
            found[key] = conv, work.get(key, weight)
            if key in work and conv.shape.direction is not Direction.BACKWARD_WEIGHTS:
                places = _first_float(weight), _first_float(work[key])
                self._jobs[conv.lay_out].append((conv.shape, *places))
        return found

    def lay_out(self) -> None:
        """Lay out the weights for the kernels, in a launch for each kind of layout."""
        for lay_out, jobs in self._jobs.items():
            lay_out(self.net.dev, self.net.all_parameters, jobs, self._work)
        self.is_laid_out = True

    def sum_parts(self) -> None:
        """Overwrite the gradients of all parameters by the sums of the parts that `backward` has
        left.
        """
        net = self.net
        rows, n = table_of_sums(self._sums)
        net.dev.send(self._table, np.array(rows, np.int32))
        sum_parts(net.dev, self._table, n, self._work, net.all_gradients, net.all_gradients)
        self._sums = []

    # ---- launches

    def _compute(self, layer, planned, tiles):
        """Compute a layer's output. planned: of a convolution, what computes it and its weights."""
        net, arrays, of_layer = self.net, self.arrays, tiles.tiles(layer.name)
        sources, out = tuple(arrays[name] for name in layer.inputs), arrays[layer.name]
        if layer.kind == "gate":
            gate_forward(net.dev, sources[0], out, tiles=of_layer)
        elif layer.kind == "pool":
            avgpool2_forward(net.dev, sources[0], out, tiles=of_layer)
        elif layer.kind == "upsample":
            upsample2_forward(net.dev, sources[0], out, tiles=of_layer)
        else:
            conv, weights = planned
            bias = net.parameters[f"{layer.name}.bias"]
            conv.forward(sources, weights, bias, out, relu=layer.relu, tiles=of_layer)

    def _compute_gradient(self, layer, source, planned, tiles):
        """Compute the gradient of a layer's input of number `source`. planned: of a convolution,
        what computes it and its weights.
        """
        net, name = self.net, layer.inputs[source]
        x, grad_x = self.arrays[name], self.arrays[gradient_of(name)]
        grad_out = self.arrays[gradient_of(layer.name)]
        of_input = tiles.tiles(gradient_of(name))
        mask = x if name in net.relu_outputs else None
        if layer.kind == "gate":
            gate_backward(net.dev, x, grad_out, grad_x, tiles=of_input)
        elif layer.kind == "pool":  # adds to the gradient of the skip
            avgpool2_backward(net.dev, mask, grad_out, grad_x, tiles=of_input)
        elif layer.kind == "upsample":
            upsample2_backward(net.dev, grad_out, grad_x, tiles=of_input)
        else:
            conv, weights = planned
            conv.backward_input(weights, grad_out, grad_x, mask=mask, tiles=of_input)

    def _compute_gradient_of_weights(self, layer, planned, tiles):
        """Compute the parts of the gradients of a convolution's weights and bias. planned: what
        computes them, and where they go.
        """
        net, grad = self.net, gradient_of(layer.name)
        conv, parts = planned
        sources = tuple(self.arrays[name] for name in layer.inputs)
        count = conv.backward_weights(sources, self.arrays[grad], parts, tiles=tiles.tiles(grad))
        gradients = (net.gradients[f"{layer.name}.{kind}"] for kind in ("weight", "bias"))
        self._sums.append((parts.shape, count, *map(_first_float, (parts, *gradients))))

    def _copy(self, name, tiles):
        """Copy the tiles of a feature map that were not computed from equal ones."""
        tiles.fill_copies(name, self.arrays[name])


def _work_table(convs):
    """{Work: (shape, dtype)} of the arrays that convolutions take beside a layer's own."""
    return {key: (c.work_shape, np.float32) for key, c in convs.items() if c.work_shape}


def _row_of(array):
    return array.shape, array.dtype


def _first_float(array):
    """Where an array of packed_arrays() begins in the whole."""
    return array.base_data.offset // array.dtype.itemsize


class UNet:
    """The network, its parameters and gradients, and the buffers it works in.

    widths: channels of the three levels. blocks: what a level computes, of settings.BLOCKS.
    residual: adds output.SHARE of the first three features to the
    image. variant: of the convolutions, as choose() takes it; blocking: of their kernels, as
    shipped for the device; both may be replaced before the first pass. layers: in the order of the
    forward pass. parameters, gradients: {"enc0.a.weight": (ceil(CO/16), K, K, CI, 16),
    "enc0.a.bias": (ceil(CO/16) * 16,), ...} float32 on the device; all_parameters, all_gradients:
    the 1-D array that they lie in, with zeros between them. Weights and biases start uniform in
    +-1/sqrt(CI K K) (PyTorch's default for Conv2d), output channels beyond CO at 0, with gradient
    0. multiple: of which the sides of images are, in pixels.
    """

    multiple = 4  # two poolings halve the height and the width

    def __init__(
        self,
        dev: Device,
        widths: tuple[int, int, int] = (16, 32, 64),
        *,
        blocks: str = "double",
        residual: bool = False,
        seed: int = 0,
        variant: str = AUTO,
    ):
        self.dev = dev
        self._residual = residual
        self.layers = unet_layers(widths, blocks=blocks)
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
        self.relu_outputs = {layer.name for layer in self.layers if layer.relu}
        self._passes: dict[bool, Pass] = {}  # {training: Pass}
        self._tile_lists = {name: PackedArrays(dev) for name in ("forward", "backward")}
        self._trained: Any = None  # tiles of the last forward(training=True), until its backward()
        self._is_frozen = False

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

    def _packed(self):
        """(zeros like all_parameters, {name: array in them}) of the parameters."""
        table = parameter_table(self.layers)
        whole, arrays = packed_arrays(self.dev, [*table.values()])
        return whole.view(np.float32), dict(zip(table, arrays, strict=True))

    def split(self, whole: Array) -> dict[str, Array]:
        """{name of a parameter: its part of an array that is laid out as all_parameters}."""
        parts = {}
        for name, parameter in self.parameters.items():
            start = _first_float(parameter)
            parts[name] = whole[start : start + parameter.size].reshape(parameter.shape)
        return parts

    def freeze(self) -> None:
        """From now on the parameters do not change: their weights are laid out for the kernels
        once, not for each image, and training is refused.
        """
        self._is_frozen = True
        self._passes.clear()

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

    def gradient_tiles(
        self,
        target: Array,
        ignored: np.ndarray | None,
        size: tuple[int, int],
        corner: Sequence[int],
    ) -> Callable[[], np.ndarray | None]:
        """A function that returns gradient_tiles of plan_tiles() for a step with this target,
        (h, w, 3) float32, whose corner lies at (left, top) of the image of `size`. It is called
        once the device has been waited for anyway: looking at the target costs no wait.

        ignored: (h, w) bool, the pixels that say nothing, if there are any. They are white in the
        target, but their gradient is another than the background's.
        """
        if not self.is_planned(size):
            return lambda: None
        found = tiles_find(self.dev, target, WHITE)
        beside = False if ignored is None else tiles_with(ignored)
        return lambda: gradient_tiles(found.get() | beside, size, (corner[0], corner[1]))

    def forward(self, x: Array, training: bool = True, plan: ForwardPlan | None = None) -> Array:
        """(H, W, 3) image of the features x (H, W, 16); H and W are multiples of 4.

        The result is in a buffer of the network: the next call overwrites it. training: keep what
        backward needs. plan: of plan_tiles(), None = compute all tiles. Raises ValueError for other
        sizes, RuntimeError for training once frozen.
        """
        if training and self._is_frozen:
            raise RuntimeError("UNet.freeze() was called: the network can no longer be trained")
        height, width, channels = x.shape
        taken = sum(self.layers[0].sources)
        if height % self.multiple or width % self.multiple or channels != taken:
            raise ValueError(f"the network takes (4n, 4m, {taken}) features, not {x.shape}")
        if training not in self._passes:
            self._passes[training] = Pass(self, training)
        if training:
            self._trained = None  # its arrays are overwritten
        planned = self._passes[training]
        if planned.size != (height, width):
            planned.plan((height, width))
        if not (self._is_frozen and planned.is_laid_out):
            planned.lay_out()
        planned.arrays["x"], tiles = x, plan or planned.all_tiles
        planned.run(planned.forward, tiles)
        out = planned.arrays[self.layers[-1].name]
        output_forward(self.dev, out, x if self._residual else None)
        if training:
            self._trained = tiles
        else:
            del planned.arrays["x"]  # so that the caller can free it
        return out

    def backward(self, grad_y: Array) -> Array:
        """(H, W, 16) gradient of x in the last forward(x, training=True), given dL/dy (H,
        W, 3).

        Overwrites the gradients of all parameters; parameters and x must be as they were in
        forward. The result is in a buffer of the network. Raises RuntimeError without such a
        forward.
        """
        if self._trained is None:
            raise RuntimeError("UNet.backward needs a forward(training=True) before it")
        planned, tiles, self._trained = self._passes[True], self._trained, None
        output_backward(self.dev, grad_y, planned.arrays[gradient_of(self.layers[-1].name)])
        tiles = tiles.backward(planned.arrays, self._tile_lists["backward"])
        planned.run(planned.backward, tiles)
        grad_x = planned.arrays[gradient_of("x")]
        if self._residual:
            residual_backward(self.dev, grad_y, grad_x)
        planned.sum_parts()
        del planned.arrays["x"]
        return grad_x

    def output(self, name: str) -> Array:
        """(H, W, C) output of the layer `name` in the last forward(training=True), until its
        backward pass.
        """
        return self._passes[True].arrays[name]

    def work(self, size: Size, training: bool) -> dict[Work, DirectConv]:
        """All that is computed for convolutions: their outputs, and for training the gradients of
        the weights and of each input.
        """
        found = {}
        for layer in convolutions(self.layers):
            ways: list[tuple[Direction, int | None]] = [(Direction.FORWARD, None)]
            if training:
                ways.append((Direction.BACKWARD_WEIGHTS, None))
                ways += [(Direction.BACKWARD_INPUT, i) for i in range(len(layer.sources))]
            for direction, source in ways:
                here = size[0] >> layer.level, size[1] >> layer.level
                of_layer = layer.kernel_size, layer.sources, layer.channels
                shape = ConvShape(direction, *of_layer, here, source)
                conv = choose(self.dev, shape, self.variant)(self.dev, self.blocking, shape)
                found[layer.name, direction, source] = conv
        return found

    def table(self, crop: Size, image: Size) -> Table:
        """The arrays of a network that is trained on crops of one size and renders images of
        another: its parameters, the feature maps and work of both passes, and the scratch memory
        that their convolutions share, which grows with the device's compute units.
        """
        table: Table = dict.fromkeys(("parameters", "gradients"), _row_of(self.all_parameters))
        scratch = 0
        for training, size in ((True, crop), (False, image)):
            convs = self.work(size, training)
            shapes = array_shapes(self.layers, size)
            shared = share_buffers(lifetimes(self.layers, training), shapes)
            table |= {f"{training} {i}": ((b.floats,), np.float32) for i, b in enumerate(shared)}
            table[f"{training} work"] = (table_bytes(_work_table(convs)),), np.uint8
            scratch = max(scratch, *(conv.scratch_floats() for conv in convs.values()))
        return table | {"scratch": ((scratch,), np.float32)}
