"""The network that turns feature maps into images: a U-Net of three levels (PlenopticPoints
supplemental, decoder).

Each level is two 3x3 convolutions with ReLU; levels are joined by 2x2 average pooling on the way
down, by bilinear upsampling with a 1x1 convolution and a concatenation [upsampled, skip] on the way
up; the image is 0.5 + 0.5 * (1x1 convolution). The 1x1 convolution runs before the upsampling: both
are linear and the upsampling weights of a pixel add up to 1, so they commute, bias included, and it
costs a quarter.
"""

from pp_cl.network.layer import Conv, Layer, Pool, Upsample


def unet_layers(
    widths: tuple[int, int, int], channels_in: int = 16, channels_out: int = 3
) -> list[Layer]:
    """The layers in the order of the forward pass. widths: channels of the three levels."""
    w0, w1, w2 = widths
    return [
        Conv("enc0.a", ("x",), 0, w0, (channels_in,)),
        Conv("enc0.b", ("enc0.a",), 0, w0, (w0,)),
        Pool("pool0", ("enc0.b",), 1, w0),
        Conv("enc1.a", ("pool0",), 1, w1, (w0,)),
        Conv("enc1.b", ("enc1.a",), 1, w1, (w1,)),
        Pool("pool1", ("enc1.b",), 2, w1),
        Conv("enc2.a", ("pool1",), 2, w2, (w1,)),
        Conv("enc2.b", ("enc2.a",), 2, w2, (w2,)),
        Conv("up1", ("enc2.b",), 2, w1, (w2,), kernel_size=1, relu=False),
        Upsample("wide1", ("up1",), 1, w1),
        Conv("dec1.a", ("wide1", "enc1.b"), 1, w1, (w1, w1)),
        Conv("dec1.b", ("dec1.a",), 1, w1, (w1,)),
        Conv("up0", ("dec1.b",), 1, w0, (w1,), kernel_size=1, relu=False),
        Upsample("wide0", ("up0",), 0, w0),
        Conv("dec0.a", ("wide0", "enc0.b"), 0, w0, (w0, w0)),
        Conv("dec0.b", ("dec0.a",), 0, w0, (w0,)),
        Conv("out", ("dec0.b",), 0, channels_out, (w0,), kernel_size=1, relu=False),
    ]


def convolutions(layers: list[Layer]) -> list[Conv]:
    """The layers that have parameters."""
    return [layer for layer in layers if isinstance(layer, Conv)]


def multiplications(layers: list[Layer], height: int, width: int) -> int:
    """Multiplications of weights by values in a forward pass over an image of this size."""
    return sum(layer.multiplications(height, width) for layer in layers)
