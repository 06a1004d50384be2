"""The network's layers other than convolutions, on (H, W, C) float32 feature maps: gates, pooling,
bilinear upsampling, and the final image.

tiles: the tiles of the result to compute, None = all. All functions raise ValueError for shapes
that do not fit.
"""

from typing import Any

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import channel_ranges, lanes, launch_groups
from pp_cl.engine.layers.tiles import Tiles, all_tiles

GATE, RESAMPLE = "layers/gate", "layers/resample"
OUTPUT, FIRST_FEATURES = "layers/output", "layers/first_features"
PIXELS_TOGETHER = 64  # pixels of a work-group of the specular layer on GPUs
SHARE = 0.25  # of a feature in its colour: features vary about four times as much as colours


def gate_forward(dev: Device, x: Array, out: Array, *, tiles: Tiles | None = None) -> None:
    """out (H, W, C) = ELU(features) * sigmoid(gates). x: (H, W, 2 C), the features of each pixel
    and then its gates.
    """
    _launch(dev, GATE, "gate_forward", out.shape, out, tiles, x=x, out=out)


def gate_backward(
    dev: Device, x: Array, grad_out: Array, grad_x: Array, *, tiles: Tiles | None = None
) -> None:
    """grad_x (H, W, 2 C) = gradient of gate_forward, given grad_out (H, W, C)."""
    arrays = {"x": x, "grad_out": grad_out, "grad_x": grad_x}
    _launch(dev, GATE, "gate_backward", grad_out.shape, grad_x, tiles, **arrays)


def avgpool2_forward(dev: Device, x: Array, out: Array, *, tiles: Tiles | None = None) -> None:
    """out (H, W, C) = mean of 2x2 pixels of x (2H, 2W, C)."""
    _launch(dev, RESAMPLE, "avgpool2_forward", out.shape, out, tiles, x=x, out=out)


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

    mask: the pooled array if it is a ReLU's output, otherwise None; grad_x: gradient through its
    other use; grad_out: (H, W, C).
    """
    masking = {"masked": mask is not None, "x": mask}
    arrays, of_items = {"grad_out": grad_out, "grad_x": grad_x}, grad_x.shape
    shape = grad_out.shape
    _launch(dev, RESAMPLE, "avgpool2_backward", shape, grad_x, tiles, of_items, **masking, **arrays)


def maxpool2_forward(dev: Device, x: Array, out: Array) -> None:
    """out (H // 2, W // 2, C) = maximum of 2x2 pixels of x (H, W, C)."""
    h, w, c = out.shape
    if (x.shape[0] // 2, x.shape[1] // 2, x.shape[2]) != out.shape:
        raise ValueError(f"max pooling of {x.shape} to {out.shape}")
    size, work_group = channel_ranges(dev, h, w, c)
    sizes = {"h": h, "w": w, "c": c, "x_width": x.shape[1]}
    dev.program("layers/maxpool", LANES=lanes(dev)).launch(
        "maxpool2_forward", size, work_group, x=x, out=out, **sizes
    )


def upsample2_forward(dev: Device, x: Array, out: Array, *, tiles: Tiles | None = None) -> None:
    """out (2H, 2W, C) = x (H, W, C), bilinear, align_corners False, border repeated."""
    _launch(dev, RESAMPLE, "upsample2_forward", x.shape, out, tiles, x=x, out=out)


def upsample2_backward(
    dev: Device, grad_out: Array, grad_x: Array, *, tiles: Tiles | None = None
) -> None:
    """grad_x (H, W, C) = gradient of upsample2_forward, given grad_out (2H, 2W, C)."""
    arrays = {"grad_out": grad_out, "grad_x": grad_x}
    _launch(dev, RESAMPLE, "upsample2_backward", grad_x.shape, grad_x, tiles, **arrays)


def _launch(dev, file, kernel, shape, result, tiles, of_items=None, **arguments):
    """Launch a kernel that computes `tiles` of the array `result`. shape: h, w, c of the smaller
    map. of_items: shape of the map that the work-items cover, if it is the other one.
    """
    h, w, c = shape
    size, work_group = channel_ranges(dev, *(of_items or shape))
    count = (tiles or all_tiles(dev, *result.shape[:2])).count
    dev.program(file, LANES=lanes(dev)).launch(
        kernel, size, work_group, h=h, w=w, c=c, tile_count=count, **arguments
    )


def output_forward(dev: Device, image: Array, features: Array | None) -> None:
    """image (H, W, 3) = 0.5 + 0.5 * image. If features (H, W, C) are given, adds SHARE * (the first
    three of them - the background's 1): a residual connection past the network. For the gradient
    see Conv.is_halved and residual_backward().
    """
    named = {"residual": features is not None, "share": SHARE, "features": features}
    shape = image.shape if features is None else features.shape
    _per_pixel(dev, OUTPUT, "output_forward", shape, image=image, **named)


def residual_backward(dev: Device, grad_image: Array, grad_features: Array) -> None:
    """Add the gradient through the residual connection to grad_features (H, W, C), given grad_image
    (H, W, 3).
    """
    grads = {"grad_image": grad_image, "grad_features": grad_features}
    _per_pixel(dev, OUTPUT, "residual_backward", grad_features.shape, share=SHARE, **grads)


def specular_forward(
    dev: Device, parameters: dict[str, Array], image: Array, of_view: dict[str, Any]
) -> None:
    """Add the colours of a specular layer to the image (H, W, 3) of a view. parameters: see
    network/specular.py. of_view: from RenderResult.specular_arguments().
    """
    n, together = image.shape[0] * image.shape[1], 1 if dev.is_cpu else PIXELS_TOGETHER
    named: dict[str, Any] = {}
    for name, array in parameters.items():
        layer, kind = name.split(".")
        named[f"{kind}_{layer}"] = array
    launch_groups(
        dev,
        "layers/specular",
        "specular_forward",
        -(-n // (together * lanes(dev))),
        most=PIXELS_TOGETHER,
        defines={
            "LANES": lanes(dev),
            "HIDDEN": parameters["a.bias"].size,
            "TOGETHER": together,
        },
        n=n,
        image=image,
        **of_view,
        **named,
    )


def first_features_forward(dev: Device, features: Array, image: Array) -> None:
    """image (H, W, 3) = the first three of the features (H, W, C)."""
    arrays = {"features": features, "image": image}
    _per_pixel(dev, FIRST_FEATURES, "first_features_forward", features.shape, **arrays)


def first_features_backward(dev: Device, grad_image: Array, grad_features: Array) -> None:
    """Write grad_features (H, W, C), 0 beyond the first three, from grad_image (H, W, 3)."""
    grads = {"grad_image": grad_image, "grad_features": grad_features}
    _per_pixel(dev, FIRST_FEATURES, "first_features_backward", grad_features.shape, **grads)


def _per_pixel(dev, file, kernel, shape, **arguments):
    """Launch a kernel with a work-item for each pixel. shape: the features' shape."""
    n = shape[0] * shape[1]
    dev.program(file).launch(kernel, n, n=n, channels=shape[2], **arguments)
