"""The network's layers that are no convolutions, on (H, W, C) float32 feature maps: gates, pooling,
bilinear upsampling, and the image at the end.

tiles: those of the result to compute, None = all. All raise ValueError for shapes that do not fit.
"""

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import channel_ranges, lanes
from pp_cl.engine.layers.tiles import Tiles, checked_tiles

RESAMPLE = "layers/resample"
SHARE = 0.25  # of a feature in its colour; features differ by about four times as much


def gate_forward(dev: Device, x: Array, out: Array, *, tiles: Tiles | None = None) -> None:
    """out (H, W, C) = ELU(features) * sigmoid(gates). x: (H, W, 2 C), the features of each pixel
    and then its gates.
    """
    shape = _check_gate(x, out)
    _launch(dev, "layers/gate", "gate_forward", shape, out, tiles=tiles, x=x, out=out)


def gate_backward(
    dev: Device, x: Array, grad_out: Array, grad_x: Array, *, tiles: Tiles | None = None
) -> None:
    """grad_x (H, W, 2 C) = gradient of gate_forward, given grad_out (H, W, C)."""
    shape, arrays = _check_gate(x, grad_out), {"x": x, "grad_out": grad_out, "grad_x": grad_x}
    _launch(dev, "layers/gate", "gate_backward", shape, grad_x, tiles=tiles, **arrays)


def avgpool2_forward(dev: Device, x: Array, out: Array, *, tiles: Tiles | None = None) -> None:
    """out (H, W, C) = mean of 2x2 pixels of x (2H, 2W, C)."""
    shape = _check_double(out, x)
    _launch(dev, RESAMPLE, "avgpool2_forward", shape, out, tiles=tiles, x=x, out=out)


def avgpool2_backward(
    dev: Device,
    mask: Array | None,
    grad_out: Array,
    grad_x: Array,
    *,
    tiles: Tiles | None = None,
) -> None:
    """Adds the gradient of avgpool2_forward to grad_x (2H, 2W, C), then sets grad_x to 0 where mask
    <= 0.

    mask: what was pooled, where it is a ReLU's output, else None; grad_x: gradient of its other
    use; grad_out: (H, W, C).
    """
    shape = _check_double(grad_out, grad_x)
    _launch(
        dev,
        RESAMPLE,
        "avgpool2_backward",
        shape,
        grad_x,
        grad_x.shape,
        tiles=tiles,
        masked=mask is not None,
        x=grad_x if mask is None else mask,
        grad_out=grad_out,
        grad_x=grad_x,
    )


def maxpool2_forward(dev: Device, x: Array, out: Array) -> None:
    """out (H // 2, W // 2, C) = largest of 2x2 pixels of x (H, W, C)."""
    h, w, c = out.shape
    if (x.shape[0] // 2, x.shape[1] // 2, x.shape[2]) != out.shape:
        raise ValueError(f"max pooling of {x.shape} to {out.shape}")
    size, work_group = channel_ranges(dev, h, w, c)
    sizes = {"h": h, "w": w, "c": c, "x_width": x.shape[1]}
    _program(dev, RESAMPLE).launch("maxpool2_forward", size, work_group, x=x, out=out, **sizes)


def upsample2_forward(dev: Device, x: Array, out: Array, *, tiles: Tiles | None = None) -> None:
    """out (2H, 2W, C) = x (H, W, C), bilinear, align_corners False, border repeated."""
    shape = _check_double(x, out)
    _launch(dev, RESAMPLE, "upsample2_forward", shape, out, tiles=tiles, x=x, out=out)


def upsample2_backward(
    dev: Device, grad_out: Array, grad_x: Array, *, tiles: Tiles | None = None
) -> None:
    """grad_x (H, W, C) = gradient of upsample2_forward, given grad_out (2H, 2W, C)."""
    shape, arrays = _check_double(grad_x, grad_out), {"grad_out": grad_out, "grad_x": grad_x}
    _launch(dev, RESAMPLE, "upsample2_backward", shape, grad_x, tiles=tiles, **arrays)


def output_forward(dev: Device, image: Array, features: Array | None) -> None:
    """image (H, W, 3) = 0.5 + 0.5 * image, and SHARE * (the first three of the features (H, W, C)
    - the background's 1), if they are given: a residual connection past the network.
    """
    height, width, channels = _check_image(image if features is None else features, image)
    dev.program("layers/output").launch(
        "output_forward",
        height * width,
        n=height * width,
        channels=channels,
        residual=features is not None,
        share=SHARE,
        features=image if features is None else features,
        image=image,
    )


def output_backward(dev: Device, grad_image: Array, grad_out: Array) -> None:
    """Write grad_out (H, W, 3), dL/d(last layer's output), from grad_image (H, W, 3)."""
    _check_image(grad_out, grad_image)
    n = grad_image.size
    dev.program("layers/output").launch(
        "output_backward", n, n=n, grad_image=grad_image, grad_out=grad_out
    )


def residual_backward(dev: Device, grad_image: Array, grad_features: Array) -> None:
    """Add the gradient through the residual connection, of grad_image (H, W, 3), to grad_features
    (H, W, C).
    """
    height, width, channels = _check_image(grad_features, grad_image)
    dev.program("layers/output").launch(
        "residual_backward",
        height * width,
        n=height * width,
        channels=channels,
        share=SHARE,
        grad_image=grad_image,
        grad_features=grad_features,
    )


def mean_forward(dev: Device, features: Array, image: Array, scale: int) -> None:
    """image (H, W, 3) = means of the first three features of scale x scale pixels, of features
    (scale H, scale W, C).
    """
    sizes = _mean_sizes(image, features, scale)
    size = image.shape[1], image.shape[0]
    dev.program("layers/output").launch(
        "mean_forward", size, features=features, image=image, **sizes
    )


def mean_backward(dev: Device, grad_image: Array, grad_features: Array, scale: int) -> None:
    """Write grad_features (scale H, scale W, C), 0 beyond the first three, from grad_image (H, W,
    3).
    """
    sizes = _mean_sizes(grad_image, grad_features, scale)
    size = grad_features.shape[1], grad_features.shape[0]
    dev.program("layers/output").launch(
        "mean_backward", size, grad_image=grad_image, grad_features=grad_features, **sizes
    )


def _mean_sizes(image, features, scale):
    height, width, channels = image.shape
    if channels != 3 or features.shape[:2] != (height * scale, width * scale):
        raise ValueError(f"means of {scale}x{scale} pixels of {features.shape}: no {image.shape}")
    return {"height": height, "width": width, "scale": scale, "channels": features.shape[2]}


def _launch(dev, file, kernel, shape, result, size=None, *, tiles, **arguments):
    """Launch a kernel that computes the tiles of the array `result`. shape: its h, w, c, those of
    the smaller map; size: over which (height, width, channels) it runs, if not these.
    """
    h, w, c = shape
    size, work_group = channel_ranges(dev, *(size or shape))
    count = checked_tiles(dev, tiles, *result.shape[:2]).count
    _program(dev, file).launch(
        kernel, size, work_group, h=h, w=w, c=c, tile_count=count, **arguments
    )


def _program(dev, file):
    return dev.program(file, LANES=lanes(dev))


def _check_double(small, large):
    h, w, c = small.shape
    if large.shape != (2 * h, 2 * w, c):
        raise ValueError(
            f"a layer between {small.shape} and {large.shape}: expected {(2 * h, 2 * w, c)}"
        )
    return h, w, c


def _check_gate(x, out):
    h, w, c = out.shape
    if x.shape != (h, w, 2 * c):
        raise ValueError(f"a gate from {x.shape} to {out.shape}: expected {(h, w, 2 * c)}")
    return h, w, c


def _check_image(features, image):
    height, width, channels = features.shape
    if channels < 3 or image.shape != (height, width, 3):
        raise ValueError(f"an image {image.shape} is none of features {features.shape}")
    return features.shape
