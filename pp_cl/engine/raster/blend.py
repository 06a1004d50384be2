"""Computes features of the visible points from their spherical harmonics, and blends them into the
pixels by the fragments' weights; gathers the gradients of the blend by visible point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, launch_groups, replayed, row_parts
from pp_cl.engine.raster.footprint import FOOTPRINTS, footprint_macros, sample_macros
from pp_cl.engine.raster.pairs import Pairs
from pp_cl.engine.raster.points import four_blocks, stored_degree
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.raster.softmax import softmax_gradient
from pp_cl.engine.raster.weights import BlendWeights, clear_pairs

ON_GPU = 4  # lanes on GPUs: each work-item reads vectors
SPAN = 64  # pixels that share a sum of the distortion loss


def shade_forward(
    dev: Device,
    points: ProjectedPoints,
    visible: Array,
    count: int,
    sh: list[Array],
    *,
    visible_features: Array,
) -> None:
    """Write visible_features, (S, 16) float32 or longer; those of Gaussians are at least 0.

    The direction of a point is normalize(point - eye) in world axes. visible: uint32, the visible
    points, S = count of them. sh: PointCloud.sh.
    """
    sh_0, sh_1, sh_2a, sh_2b = four_blocks(sh)
    macros = footprint_macros(points.footprint)
    dev.program("raster/shade", LANES=lanes(dev), DEGREE=stored_degree(sh), **macros).launch(
        "shade_forward",
        count * row_parts(dev),
        s=count,
        visible=visible,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        sh_0=sh_0,
        sh_1=sh_1,
        sh_2a=sh_2a,
        sh_2b=sh_2b,
        visible_features=visible_features,
    )


@replayed
def blend_forward(
    dev: Device,
    b: Buffers,
    pairs: Pairs,
    weights: BlendWeights,
    visible_features: Array,
    features: Array,
) -> None:
    """Write features (H, W, 16) from visible_features, (S, 16) or longer, both float32. b: keeps
    the recorded call, see replayed().
    """
    dev.program("raster/blend", LANES=lanes(dev, ON_GPU)).launch(
        "blend_forward",
        pairs.pixels * row_parts(dev, ON_GPU),
        hw=pairs.pixels,
        pixel_offset=pairs.pixel_offset,
        pixel_weight_point=weights.pixel_weight_point,
        point_slot=weights.point_slot,
        visible_features=visible_features,
        features=features,
    )


def blend_backward_table(
    visible: int, pixels: int, pairs: int, blend: str, footprint: str = "soft", side: int = 1
) -> Table:
    """The buffers of the backward pass for a number of pixels with side x side samples each, and
    for capacities of visible points and of pairs. blend: one of BLENDS.
    """
    table: Table = {
        "pair_gradient": ((pairs, 1 + side**2), np.float32),
        "grad_visible_features": ((visible, 16), np.float32),
        "grad_opacity": ((visible,), np.float32),
    }
    if blend == "softmax":
        return table | {"pixel_blend": ((pixels,), np.float32)}
    return table | {
        "distortion": ((-(-pixels // SPAN),), np.float32),
        "grad_offset": ((visible, FOOTPRINTS[footprint].offsets), np.float32),
    }


@dataclass(frozen=True)
class BlendGradients:
    """The gradients of the visible points, float32, with at least one row for each; all other
    points have gradient 0. Valid until the next backward pass.

    visible_features: (S, 16). opacity: (S,). offset: (S, 4) for soft points composited by alpha,
    (S, 16) for Gaussians, through the falloff of their fragments; None if not asked for.
    distortion: (ceil(HW/SPAN),), the distortion loss by SPAN pixels; None if its weight is 0.
    pair_gradient: (P, 1 + samples), for each pair of a visible point the blend weight b and what
    each sample of the fragment adds to dL/dopacity; 0 where it is dropped or not tracked.
    """

    visible_features: Array
    opacity: Array
    offset: Array | None
    distortion: Array | None
    pair_gradient: Array


def blend_backward(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    *,
    visible_features: Array,
    features: Array,
    grad_features: Array,
    grad_alpha: Array | None = None,
    distortion_weight: float = 0.0,
    depth_gradient: Array | None = None,
    voxel_size: float = 0.0,
    max_weight: Array | None = None,
) -> BlendGradients:
    """The gradients of the points weights.visible, after blend_weights() with derivatives.

    visible_features, features: from blend_forward(). grad_features: dL/dfeatures (H, W, 16).
    grad_alpha: (HW,), dL/d(1 - transmittance); None: 0. distortion_weight: adds this times sum_ij
    b_i b_j |z_i - z_j| of every sample to the loss, where b and z are the weights and depths (world
    units) of its fragments; depths get no gradient. depth_gradient: (HW, 2), as
    engine/training/depth_loss.py writes it. voxel_size: the unit of offsets, in world units; 0:
    offsets get no gradients. max_weight: (N,) float32, becomes for each point the highest sum of
    its blend weights over an image's pixels so far. Raises ValueError if grad_alpha, a distortion
    loss or depth_gradient is given with a softmax, and if offsets need gradients without soft
    points or Gaussians composited by alpha.
    """
    is_alpha, moves = weights.blend == "alpha", voxel_size > 0
    has_depth = depth_gradient is not None
    if not is_alpha and (grad_alpha is not None or distortion_weight > 0 or has_depth):
        raise ValueError("a softmax has no gradient of alpha and of losses of depths")
    if moves and not (is_alpha and FOOTPRINTS[points.footprint].moves):
        raise ValueError(
            "only soft points and Gaussians composited by alpha have gradients of offsets"
        )
    count = weights.total
    rows = len(visible_features), pairs.pixels, pairs.capacity
    kind = points.footprint, points.side
    b.require(blend_backward_table(*rows, weights.blend, *kind))
    clear_pairs(dev, pairs, weights, b.pair_gradient)
    of_fragments: dict[str, Any] = {
        "hw": pairs.pixels,
        "tracked": weights.tracked,
        "pixel_offset": pairs.pixel_offset,
        "pair_key": pairs.pair_key,
        "pixel_weight_point": weights.pixel_weight_point,
        "pixel_derivative": weights.pixel_derivative,
        "grad_features": grad_features,
        "pair_gradient": b.pair_gradient,
    }
    macros, of_samples = footprint_macros(*kind), sample_macros(dev, *kind)
    if is_alpha:
        launch_groups(
            dev,
            "raster/alpha",
            "alpha_gradient",
            -(-pairs.pixels // SPAN),
            most=SPAN,
            defines=of_samples | {"SPAN": SPAN},
            has_grad_alpha=int(grad_alpha is not None),
            distortion_weight=distortion_weight,
            sample_transmittance=weights.sample_transmittance,
            opacity=weights.opacity,
            point_slot=weights.point_slot,
            visible_features=visible_features,
            grad_alpha=grad_alpha,
            has_depth=int(has_depth),
            depth_gradient=depth_gradient,
            distortion=b.distortion,
            **of_fragments,
        )
    else:
        softmax_gradient(
            dev, pairs.pixels, features=features, pixel_blend=b.pixel_blend, **of_fragments
        )
    of_points: dict[str, Any] = {
        "s": count,
        "visible": weights.visible_rows,
        "point_offset": pairs.point_offset,
        "pair_pixel": pairs.pair_pixel,
        "pair_gradient": b.pair_gradient,
    }
    dev.program("raster/blend", DL_DB=int(not is_alpha), LANES=lanes(dev, ON_GPU), **macros).launch(
        "blend_backward",
        count * row_parts(dev, ON_GPU),
        is_recorded=max_weight is not None,
        pixel_blend=None if is_alpha else b.pixel_blend,
        visible_features=visible_features,
        grad_features=grad_features,
        grad_visible_features=b.grad_visible_features,
        grad_opacity=b.grad_opacity,
        max_weight=max_weight,
        **of_points,
    )
    if moves:
        dev.program("raster/offsets", **of_samples).launch(
            "offset_gradient",
            count,
            voxel_size=voxel_size,
            radius=points.radius,
            camera=points.camera_buffer,
            point_camera=points.point_camera,
            point_shape=points.point_shape,
            cloud_offset=points.cloud_offset,
            opacity=weights.opacity,
            pair_point_falloff=pairs.pair_point_falloff,
            grad_offset=b.grad_offset,
            **of_points,
        )
    return BlendGradients(
        b.grad_visible_features,
        b.grad_opacity,
        b.grad_offset if moves else None,
        b.distortion if distortion_weight > 0 else None,
        b.pair_gradient,
    )
