"""The network that turns feature maps into images: a U-Net of three levels (PlenopticPoints
supplemental, decoder).

Each level is a block: two 3x3 convolutions with ReLU, or one of the others that the supplemental
compares with them. Levels are joined by 2x2 average pooling on the way down, by bilinear upsampling
with a 1x1 convolution and a concatenation [upsampled, skip] on the way up; the image is 0.5 + 0.5 *
(1x1 convolution). The 1x1 convolution runs before the upsampling: both are linear and the
upsampling weights of a pixel add up to 1, so they commute, bias included, and it costs a quarter.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from pp_cl.network.layer import Conv, Gate, Layer, Pool, Upsample


def _double(name, inputs, level, channels, *, sources):
    first = Conv(f"{name}.a", inputs, level, channels, sources=sources)
    return [first, Conv(f"{name}.b", (first.name,), level, channels, (channels,))]


def _single(name, inputs, level, channels, *, sources):
    return [Conv(f"{name}.a", inputs, level, channels, sources)]


def _gated(name, inputs, level, channels, *, sources):
    """Features and gates are one convolution: both read the same inputs."""
    both = Conv(f"{name}.a", inputs, level, 2 * channels, sources, relu=False)
    return [both, Gate(f"{name}.gate", (both.name,), level, channels)]


# Makes a block's layers: (name, inputs, level, channels, sources=channels of each input).
Block = Callable[..., list[Layer]]
BLOCKS: dict[str, Block] = {
    "double": _double,
    "single": _single,
    "gated": _gated,
}


def unet_layers(
    widths: tuple[int, int, int],
    channels_in: int = 16,
    channels_out: int = 3,
    blocks: str = "double",
    *,
    channels: Sequence[int] = (),
) -> list[Layer]:
    """The layers in the order of the forward pass. widths: channels of the three levels; blocks:
    what a level computes, a key of BLOCKS. channels: others, of each convolution but the last.
    Raises ValueError for another number of them.
    """
    layers = _of_widths(widths, channels_in, channels_out, blocks)
    return _of_channels(layers, channels_in, [*channels, channels_out]) if channels else layers


def _of_channels(layers, channels_in, channels):
    """The same layers with other numbers of channels, those of each convolution."""
    if len(channels) != len(convolutions(layers)):
        raise ValueError(f"{len(channels)} numbers of channels, not {len(convolutions(layers))}")
    found, numbers, changed = {"x": channels_in}, iter(channels), []
    for layer in layers:
        sources = tuple(found[name] for name in layer.inputs)
        if isinstance(layer, Conv):
            layer = replace(layer, channels=next(numbers), sources=sources)
        else:
            layer = replace(layer, channels=sources[0] // (2 if isinstance(layer, Gate) else 1))
        found[layer.name] = layer.channels
        changed.append(layer)
    return changed


def _of_widths(widths, channels_in, channels_out, blocks):
    w0, w1, w2 = widths
    block = BLOCKS[blocks]
    enc0 = block("enc0", ("x",), 0, w0, sources=(channels_in,))
    enc1 = block("enc1", ("pool0",), 1, w1, sources=(w0,))
    enc2 = block("enc2", ("pool1",), 2, w2, sources=(w1,))
    skip0, skip1 = enc0[-1].name, enc1[-1].name
    dec1 = block("dec1", ("wide1", skip1), 1, w1, sources=(w1, w1))
    dec0 = block("dec0", ("wide0", skip0), 0, w0, sources=(w0, w0))
    return [
        *enc0,
        Pool("pool0", (skip0,), 1, w0),
        *enc1,
        Pool("pool1", (skip1,), 2, w1),
        *enc2,
        Conv("up1", (enc2[-1].name,), 2, w1, (w2,), kernel_size=1, relu=False),
        Upsample("wide1", ("up1",), 1, w1),
        *dec1,
        Conv("up0", (dec1[-1].name,), 1, w0, (w1,), kernel_size=1, relu=False),
        Upsample("wide0", ("up0",), 0, w0),
        *dec0,
        Conv("out", (dec0[-1].name,), 0, channels_out, (w0,), kernel_size=1, relu=False),
    ]


def convolutions(layers: list[Layer]) -> list[Conv]:
    """The layers that have parameters."""
    return [layer for layer in layers if isinstance(layer, Conv)]


def multiplications(layers: list[Layer], height: int, width: int) -> int:
    """Multiplications of weights by values in a forward pass over an image of this size."""
    return sum(layer.multiplications(height, width) for layer in layers)
