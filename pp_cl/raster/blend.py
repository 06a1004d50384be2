"""Features of the visible points from their spherical harmonics, blended into the pixels by the
weights of the hits; and the gradients of the blend, gathered by visible point.
"""

from __future__ import annotations

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes, row_parts
from pp_cl.raster.pairs import Pairs
from pp_cl.raster.points import four_blocks, stored_degree
from pp_cl.raster.project import ProjectedPoints
from pp_cl.raster.weights import BlendWeights

ON_GPU = 4  # lanes there: each work-item reads vectors


def shade_forward(
    dev: Device,
    points: ProjectedPoints,
    shaded: Array,
    sh: list[Array],
    *,
    shaded_features: Array,
) -> None:
    """Write shaded_features, (S, 16) float32 or longer.

    The direction of a point is normalize(point - eye) in world axes. shaded: (S,) uint32, the
    visible points. sh: of PointCloud.
    """
    sh_0, sh_1, sh_2a, sh_2b = four_blocks(sh)
    dev.program("raster/shade", LANES=lanes(dev), DEGREE=stored_degree(sh)).launch(
        "shade_forward_half" if sh_0.dtype == np.float16 else "shade_forward",
        shaded.size * row_parts(dev),
        s=shaded.size,
        shaded=shaded,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        sh_0=sh_0,
        sh_1=sh_1,
        sh_2a=sh_2a,
        sh_2b=sh_2b,
        shaded_features=shaded_features,
    )


def blend_forward(
    dev: Device, pairs: Pairs, weights: BlendWeights, shaded_features: Array, features: Array
) -> None:
    """Write features (H, W, 16) from shaded_features, (S, 16) or longer, both float32."""
    _program(dev, weights).launch(
        "blend_forward",
        pairs.pixels * row_parts(dev, ON_GPU),
        hw=pairs.pixels,
        pixel_offset=pairs.pixel_offset,
        pixel_entry=weights.pixel_entry,
        point_slot=weights.point_slot,
        shaded_features=shaded_features,
        features=features,
    )


def blend_backward_table(shaded: int, pixels: int, pairs: int, blend: str) -> Table:
    """The buffers of the backward pass for a number of pixels, and room for numbers of visible
    points and of pairs. blend: one of BLENDS.
    """
    return {
        "pair_gain": ((pairs if blend == "alpha" else 1,), np.float32),
        "pixel_rest": ((pixels if blend == "softmax" else 1,), np.float32),
        "pixel_spread": ((pixels if blend == "alpha" else 1,), np.float32),
        "grad_shaded_features": ((shaded, 16), np.float32),
        "grad_opacity": ((shaded,), np.float32),
        "grad_offset": ((shaded if blend == "alpha" else 1, 4), np.float32),
    }


def blend_backward(
    dev: Device,
    b: Buffers,
    pairs: Pairs,
    weights: BlendWeights,
    *,
    shaded_features: Array,
    features: Array,
    grad_features: Array,
    grad_alpha: Array | None = None,
    spread_weight: float = 0.0,
    mean: bool = False,
) -> tuple[Array, Array, Array]:
    """(grad_shaded_features (S, 16), grad_opacity (S,), both or longer, pixel_spread (HW,)),
    float32, valid until the next call: the gradients of the points weights.shaded, while those of
    all others are 0; and the spread of each pixel, undefined without spread_weight. b.pair_gain
    (alpha) or b.pixel_rest (softmax) are left for offset_backward() and bench/spheres.py: the
    gains, and what they follow from (cl/raster/blend.cl).

    shaded_features, features: of blend_forward(). grad_features: dL/dfeatures (H, W, 16).
    grad_alpha: (HW,), dL/d(1 - transmittance); None: 0. spread_weight: adds this times sum_ij b_i
    b_j |z_i - z_j| of every pixel to the loss, with b and z the weights and depths (world units) of
    its hits; no gradient of the depths is formed. mean: a point's gradients are divided by its
    number of tracked pixels, as Pulsar does. Raises ValueError for grad_alpha or a spread of a
    softmax, which has no transmittance.
    """
    rows, shaded = len(shaded_features), weights.shaded
    b.require(blend_backward_table(rows, pairs.pixels, pairs.capacity, weights.blend))
    program = _program(dev, weights, mean)
    if weights.blend == "softmax":
        if grad_alpha is not None or spread_weight > 0:
            raise ValueError("a softmax has no gradient of alpha and of spread")
        program.launch(
            "softmax_rest",
            pairs.pixels,
            hw=pairs.pixels,
            features=features,
            grad_features=grad_features,
            pixel_rest=b.pixel_rest,
        )
    else:
        program.launch(
            "alpha_gain",
            pairs.pixels,
            hw=pairs.pixels,
            has_grad_alpha=int(grad_alpha is not None),
            spread_weight=spread_weight,
            pixel_offset=pairs.pixel_offset,
            pair_key=pairs.pair_key,
            pixel_entry=weights.pixel_entry,
            transmittance=weights.transmittance,
            point_slot=weights.point_slot,
            shaded_features=shaded_features,
            grad_features=grad_features,
            grad_alpha=weights.transmittance if grad_alpha is None else grad_alpha,
            pair_gain=b.pair_gain,
            pixel_spread=b.pixel_spread,
        )
    program.launch(
        "blend_backward",
        shaded.size * row_parts(dev, ON_GPU),
        s=shaded.size,
        shaded=shaded,
        shaded_features=shaded_features,
        point_offset=pairs.point_offset,
        pair_pixel=pairs.pair_pixel,
        pair_weight=weights.pair_weight,
        pair_role=weights.pair_role,
        pair_gain=b.pair_gain,
        pixel_rest=b.pixel_rest,
        grad_features=grad_features,
        grad_shaded_features=b.grad_shaded_features,
        grad_opacity=b.grad_opacity,
    )
    return b.grad_shaded_features, b.grad_opacity, b.pixel_spread


def offset_backward(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    *,
    opacity: Array,
    edge: float,
) -> Array:
    """grad_offset (S, 4) float32 or longer, valid until the next call, after blend_backward(): of
    soft points that are composited by alpha, of what the closeness of their hits changes.

    opacity: (N,). edge: of the grid that offsets are counted in, world units.
    """
    dev.program("raster/offset", HAS_ROLES=int(weights.has_roles)).launch(
        "offset_backward",
        weights.shaded.size,
        s=weights.shaded.size,
        edge=edge,
        shaded=weights.shaded,
        camera=points.camera_buffer,
        point_radius=points.point_radius,
        point_camera=points.point_camera,
        opacity=opacity,
        point_offset=pairs.point_offset,
        pair_pixel=pairs.pair_pixel,
        pair_point_closeness=pairs.pair_point_closeness,
        pair_weight=weights.pair_weight,
        pair_role=weights.pair_role,
        pair_gain=b.pair_gain,
        grad_offset=b.grad_offset,
    )
    return b.grad_offset


def _program(dev, weights, mean=False):
    return dev.program(
        "raster/blend",
        LANES=lanes(dev, ON_GPU),
        HAS_ROLES=int(weights.has_roles),
        HAS_PAIR_GAIN=int(weights.blend == "alpha"),
        MEAN=int(mean),
    )
