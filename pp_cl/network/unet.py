"""The network that turns feature maps into images: a U-Net of three levels (PlenopticPoints
supplemental, decoder).

Each level is two 3x3 convolutions with ReLU; levels are joined by 2x2 average pooling on the way
down, by bilinear upsampling with a 1x1 convolution and a concatenation [upsampled, skip] on the way
up; the image is 0.5 + 0.5 * (1x1 convolution). The 1x1 convolution runs before the upsampling: both
are linear and the upsampling weights of a pixel add up to 1, so they commute, bias included, and it
costs a quarter.
"""

import math
from dataclasses import dataclass

import numpy as np

from pp_cl.layers import resample as layers
from pp_cl.layers import variants
from pp_cl.layers.conv import pack_bias, pack_weights
from pp_cl.layers.tiles import grid_shape, tiles_find
from pp_cl.network.buffers import assign_slots, lifetimes
from pp_cl.network.sparse_tiles import ActiveBackward, ActiveForward, Everything

# Tiles are chosen in images of so many pixels or more, if that leaves at most such a share of the
# multiplications: choosing takes time as well.
LEAST_PIXELS, MOST_SHARE = 1 << 16, 0.8


@dataclass(frozen=True)
class Step:
    """One operation of the network, named like its output: conv3 (with ReLU), conv1 (without),
    pool, up.
    """

    kind: str
    name: str
    # names of one step, or of the two that a convolution reads as one; "x" is the network's input
    inputs: tuple
    level: int  # of the output: height and width are those of x divided by 2**level
    channels: int  # of the output


def unet_steps(widths, channels_out):
    """The network in the order of its forward pass."""
    w0, w1, w2 = widths
    return [
        Step("conv3", "enc0.a", ("x",), 0, w0),
        Step("conv3", "enc0.b", ("enc0.a",), 0, w0),
        Step("pool", "pool0", ("enc0.b",), 1, w0),
        Step("conv3", "enc1.a", ("pool0",), 1, w1),
        Step("conv3", "enc1.b", ("enc1.a",), 1, w1),
        Step("pool", "pool1", ("enc1.b",), 2, w1),
        Step("conv3", "enc2.a", ("pool1",), 2, w2),
        Step("conv3", "enc2.b", ("enc2.a",), 2, w2),
        Step("conv1", "up1", ("enc2.b",), 2, w1),
        Step("up", "wide1", ("up1",), 1, w1),
        Step("conv3", "dec1.a", ("wide1", "enc1.b"), 1, w1),
        Step("conv3", "dec1.b", ("dec1.a",), 1, w1),
        Step("conv1", "up0", ("dec1.b",), 1, w0),
        Step("up", "wide0", ("up0",), 0, w0),
        Step("conv3", "dec0.a", ("wide0", "enc0.b"), 0, w0),
        Step("conv3", "dec0.b", ("dec0.a",), 0, w0),
        Step("conv1", "out", ("dec0.b",), 0, channels_out),
    ]


class UNet:
    """The network, its parameters and gradients, and the buffers it works in.

    widths: channels of the three levels. parameters, gradients: {"enc0.a.weight": (ceil(CO/16), K,
    K, CI, 16), "enc0.a.bias": (ceil(CO/16) * 16,), ...} float32 on the device. Weights and biases
    start uniform in +-1/sqrt(CI K K) (PyTorch's default for Conv2d), output channels beyond CO at
    0, with gradient 0.

    variant: of all 3x3 convolutions that it fits, a name in variants.VARIANTS; "auto" takes the
    fastest for each. It may be set to another one between two images. share: of the last forward
    pass's multiplications that were computed; see forward's background.
    """

    def __init__(
        self, dev, widths=(16, 32, 64), channels_in=16, channels_out=3, seed=0, variant="auto"
    ):
        if variant not in ("auto", *variants.VARIANTS):
            raise ValueError(f"variant {variant!r}: must be auto, {', '.join(variants.VARIANTS)}")
        self.dev = dev
        self.variant = variant
        self.steps = unet_steps(widths, channels_out)
        self.channels = {"x": channels_in} | {s.name: s.channels for s in self.steps}
        self.parameters = {}
        rng = np.random.default_rng(seed)
        for step in self._convolutions():
            k, ci = int(step.kind[-1]), sum(self.channels[i] for i in step.inputs)
            bound = 1 / np.sqrt(ci * k * k)
            weight = rng.uniform(-bound, bound, (step.channels, ci, k, k))
            self.parameters[step.name + ".weight"] = dev.upload(pack_weights(weight))
            self.parameters[step.name + ".bias"] = dev.upload(
                pack_bias(rng.uniform(-bound, bound, step.channels))
            )
        self.gradients = {name: dev.zeros(p.shape) for name, p in self.parameters.items()}
        self._relu_outputs = {s.name for s in self.steps if s.kind == "conv3"}
        # {training: (size, {name: array}, the buffers they are views of, variants that "work"
        # suits)}
        self._buffers = {}
        self._trained = None  # (arrays, pass) of the last forward(training=True)
        self._laid_out = None  # {(step, variant): weights} once frozen
        self.share = 1.0

    def forward(self, x, training=True, background=None):
        """(H, W, 3) image of the features x (H, W, channels_in); H and W are multiples of 4.

        The result lives in a buffer of the network: the next call overwrites it. training: keep
        what backward needs. background: the value of x where there is nothing; where the network
        sees that alone, in large images, one tile is computed in place of many equal ones
        (active.py), with the same result. None = compute everything. Raises ValueError for other
        sizes, RuntimeError for training once frozen.
        """
        if training and self._laid_out is not None:
            raise RuntimeError("UNet.freeze() was called: the network can no longer be trained")
        height, width, channels = x.shape
        if height % 4 or width % 4 or channels != self.channels["x"]:
            raise ValueError(
                f"the network takes (4n, 4m, {self.channels['x']}) features, not {x.shape}"
            )
        arrays = self._arrays(height, width, training)
        arrays["x"] = x
        active = self._active_forward(arrays, background)
        for step in self.steps:
            sources, out, tiles = (
                [arrays[name] for name in step.inputs],
                arrays[step.name],
                active.tiles(step.name),
            )
            if step.kind == "pool":
                layers.avgpool2_forward(self.dev, sources[0], out, tiles)
            elif step.kind == "up":
                layers.upsample2_forward(self.dev, sources[0], out, tiles)
            else:
                weight, bias = (
                    self.parameters[step.name + ".weight"],
                    self.parameters[step.name + ".bias"],
                )
                variant = self._variant_of(step, "forward", height, width)
                variants.forward(
                    self.dev,
                    variant,
                    sources[0],
                    weight,
                    bias,
                    out,
                    step.kind == "conv3",
                    arrays["work"],
                    sources[1] if len(sources) > 1 else None,
                    tiles,
                    self._weights_of(step, variant),
                )
            active.complete(step.name, out)
        layers.affine(self.dev, 0.5, 0.5, out, out)
        if training:
            self._trained = arrays, active
        return out

    def freeze(self):
        """From now on the parameters stay as they are: the weights are laid out for the kernels
        once, not for each image.
        """
        self._laid_out = {}

    def _weights_of(self, step, variant):
        """The weights as a variant wants them, if the network is frozen."""
        if self._laid_out is None:
            return None
        if (step, variant) not in self._laid_out:
            self._laid_out[step, variant] = variants.lay_out(
                self.dev, variant, self.parameters[step.name + ".weight"]
            )
        return self._laid_out[step, variant]

    def output(self, name):
        """(H, W, C) output of the step `name` in the last forward(training=True), until its
        backward pass.
        """
        return self._trained[0][name]

    def backward(self, grad_y):
        """(H, W, channels_in) gradient of x in the last forward(x, training=True), given dL/dy (H,
        W, 3).

        Overwrites the gradients of all parameters; parameters and x must be as they were in
        forward. The result lives in a buffer of the network. Raises RuntimeError without such a
        forward.
        """
        if self._trained is None:
            raise RuntimeError("UNet.backward needs a forward(training=True) before it")
        (arrays, active), self._trained = self._trained, None
        layers.affine(self.dev, 0.5, 0.0, grad_y, arrays["grad out"])
        if isinstance(active, ActiveForward):
            active = self._active_backward(arrays, active)
        for step in reversed(self.steps):
            grad_out, name = arrays["grad " + step.name], step.inputs[0]
            active.complete(step.name, grad_out)
            # comes after the other use of its input, the skip, and adds to that one's gradient
            if step.kind == "pool":
                layers.avgpool2_backward(
                    self.dev, arrays[name], grad_out, arrays["grad " + name], active.tiles(name)
                )
            elif step.kind == "up":
                layers.upsample2_backward(
                    self.dev, grad_out, arrays["grad " + name], active.tiles(name)
                )
            else:
                self._backward_convolution(step, arrays, grad_out, active)
        active.complete("x", arrays["grad x"])
        return arrays["grad x"]

    def _active_forward(self, arrays, background):
        """The pass over the tiles that this input needs."""
        x, self.share = arrays["x"], 1.0
        if background is None or x.shape[0] * x.shape[1] < LEAST_PIXELS:
            return arrays["everything"]
        active = ActiveForward(
            self.dev, self.steps, x.shape[:2], tiles_find(self.dev, x, background)
        )
        share = self._share_of(active)
        if share > MOST_SHARE:
            return arrays["everything"]
        self.share = share
        return active

    def _active_backward(self, arrays, forward):
        """The pass backward; all activations that it reads are there."""
        active = ActiveBackward(self.dev, self.steps, forward, arrays["grad out"])
        for name, read in active.activations.items():
            forward.complete(name, arrays[name], read)
        return active

    def _share_of(self, active):
        """Share of the convolutions' multiplications that a pass computes."""
        count = {
            s.name: int(s.kind[-1]) ** 2 * sum(self.channels[i] for i in s.inputs) * s.channels
            >> 2 * s.level
            for s in self._convolutions()
        }
        return sum(n * active.layouts[name].computed.mean() for name, n in count.items()) / sum(
            count.values()
        )

    def _backward_convolution(self, step, arrays, grad_out, active):
        weight, work = self.parameters[step.name + ".weight"], arrays["work"]
        sources = [arrays[name] for name in step.inputs]
        height, width, _ = arrays["x"].shape
        variants.backward_weights(
            self.dev,
            self._variant_of(step, "weights", height, width),
            sources[0],
            grad_out,
            self.gradients[step.name + ".weight"],
            self.gradients[step.name + ".bias"],
            work,
            sources[1] if len(sources) > 1 else None,
            active.tiles(step.name),
        )
        first = 0
        for name, source in zip(step.inputs, sources, strict=True):
            variant = self._variant_of(step, "input", height, width, name)
            variants.backward_input(
                self.dev,
                variant,
                source,
                weight,
                first,
                grad_out,
                arrays["grad " + name],
                name in self._relu_outputs,
                work,
                active.tiles(name),
            )
            first += self.channels[name]

    def _variant_of(self, step, direction, height, width, name=None):
        """Variant of a convolution in an image of this size; name: of the input whose gradient is
        computed.
        """
        channels, co, k = [self.channels[i] for i in step.inputs], step.channels, int(step.kind[-1])
        if self.variant == "auto":
            ci = self.channels[name] if name else sum(channels)
            return variants.pick_variant(
                self.dev, direction, ci, co, height >> step.level, width >> step.level, k, channels
            )
        return variants.applicable(self.variant, k, *channels, co)

    def memory_plan(self, height, width, training):
        """[(name, shape, bytes)] of all device buffers of this network once it has run at this
        size.

        Gradients of parameters are among them without training too: they are made with the network.
        """
        plan = [
            (" = ".join(slot.names), (slot.floats,), slot.floats * 4)
            for slot in assign_slots(lifetimes(self.steps, training), self._shapes(height, width))
        ]
        plan += [(name, p.shape, p.nbytes) for name, p in self.parameters.items()]
        plan += [(f"grad {name}", g.shape, g.nbytes) for name, g in self.gradients.items()]
        plan += [
            ("convolutions at work", (floats,), floats * 4)
            for floats in self._work_floats(height, width, training)
        ]
        for level in set(self._levels().values()):
            number = math.prod(grid_shape(height >> level, width >> level))
            plan += [(f"tiles of level {level}", (2 * number + 3,), (2 * number + 3) * 4)]
        return plan

    def _levels(self):
        return {"x": 0} | {step.name: step.level for step in self.steps}

    def _convolutions(self):
        return [s for s in self.steps if s.kind.startswith("conv")]

    def _shapes(self, height, width):
        shapes = {s.name: (height >> s.level, width >> s.level, s.channels) for s in self.steps}
        shapes["x"] = (height, width, self.channels["x"])
        return shapes | {"grad " + name: shape for name, shape in shapes.items()}

    def _work_floats(self, height, width, training):
        """Floats of Work's two arrays that the convolutions of this size share."""
        uses = [(step, "forward", None) for step in self._convolutions()]
        if training:
            uses += [(step, "weights", None) for step in self._convolutions()]
            uses += [(step, "input", name) for step in self._convolutions() for name in step.inputs]
        needs = [
            variants.work_floats(
                self.dev,
                self._variant_of(step, direction, height, width, name),
                direction,
                height >> step.level,
                self.parameters[step.name + ".weight"].shape,
                self.channels.get(name),
            )
            for step, direction, name in uses
        ]
        return [max(1, *floats) for floats in zip(*needs, strict=True)]

    def _arrays(self, height, width, training):
        """{name: array} for this size, allocated anew only when the size changes."""
        if training not in self._buffers or self._buffers[training][0] != (height, width):
            self._buffers.pop(training, None)  # the old buffers go before the new ones come
            if training:
                self._trained = None
            shapes, arrays = self._shapes(height, width), {}
            slots = assign_slots(lifetimes(self.steps, training), shapes)
            buffers = [self.dev.empty(slot.floats) for slot in slots]
            for slot, buffer in zip(slots, buffers, strict=True):
                arrays |= {
                    name: buffer[: int(np.prod(shapes[name]))].reshape(shapes[name])
                    for name in slot.names
                }
            arrays["work"] = variants.Work(self.dev.empty(1), self.dev.empty(1))
            arrays["everything"] = Everything(self.dev, (height, width), self._levels())
            self._buffers[training] = ((height, width), arrays, buffers, set())
        _, arrays, _, suited = self._buffers[training]
        if self.variant not in suited:  # it may be changed between two images
            arrays["work"].grow(self.dev, *self._work_floats(height, width, training))
            suited.add(self.variant)
        return arrays
