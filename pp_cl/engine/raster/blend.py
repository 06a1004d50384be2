"""Computes features of the visible points from their spherical harmonics, and blends them into the
pixels by the fragments' weights; sums the gradients of the blend by tile, then by visible point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes, replayed, row_parts
from pp_cl.engine.raster.footprint import FOOTPRINTS
from pp_cl.engine.raster.pairs import Pairs, launch_tiles
from pp_cl.engine.raster.points import four_blocks, stored_degree
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.raster.weights import BlendWeights


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
    macros = {"DEGREE": stored_degree(sh), **points.macros()}
    dev.program("raster/shade", LANES=lanes(dev), **macros).launch(
        "shade_forward",
        count * row_parts(dev),
        s=count,
        visible=visible,
        camera=points.camera_buffer,
        point_record=points.point_record,
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
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    visible_features: Array,
    features: Array,
) -> None:
    """Write features (H, W, 16) from visible_features, (S, 16) or longer, both float32. b: keeps
    the recorded call, see replayed().
    """
    launch_tiles(
        dev,
        "raster/blend",
        "blend_forward",
        points,
        pairs,
        point_slot=weights.point_slot,
        visible_features=visible_features,
        transmittance=weights.transmittance,
        features=features,
        **weights.walk(),
    )


def blend_backward_table(
    visible: int, pairs: int, tiles: int, blend: str, footprint: str = "soft", moves: bool = True
) -> Table:
    """The buffers of the backward pass for capacities of visible points and of pairs, and a number
    of tiles. blend: one of BLENDS. moves: with gradients of offsets, if these points have any.
    """
    moves = moves and blend == "alpha" and FOOTPRINTS[footprint].moves
    table: Table = {
        "pair_features": ((pairs, 16), np.float32),
        "pair_sums": ((pairs, 8 if moves else 2), np.float32),
        "pair_shows": ((pairs,), np.uint8),
        "grad_visible_features": ((visible, 16), np.float32),
        "grad_opacity": ((visible,), np.float32),
        "distortion": ((tiles,), np.float32),
    }
    if not moves:
        return table
    return table | {"grad_offset": ((visible, FOOTPRINTS[footprint].offsets), np.float32)}


@dataclass(frozen=True)
class BlendGradients:
    """The gradients of the visible points, float32, with at least one row for each; all other
    points have gradient 0. Valid until the next backward pass.

    visible_features: (S, 16). opacity: (S,). offset: (S, 4) for soft points composited by alpha,
    (S, 16) for Gaussians, through the falloff of their fragments; None if not asked for.
    distortion: (TILES,), the distortion loss by tile; None if its weight is 0.
    """

    visible_features: Array
    opacity: Array
    offset: Array | None
    distortion: Array | None


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
    """The gradients of the points weights.visible, after blend_weights() with derivatives, for
    pairs numbered by point.

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
    capacities = len(visible_features), pairs.capacity, len(weights.tile_shown)
    b.require(blend_backward_table(*capacities, weights.blend, points.footprint, moves))
    dev.fill(b.pair_shows, 0)
    of_pairs: dict[str, Any] = {
        "point_offset": pairs.point_offset,
        "visible_features": visible_features,
        "pair_features": b.pair_features,
        "grad_visible_features": b.grad_visible_features,
        "pair_sums": b.pair_sums,
        "pair_shows": b.pair_shows,
    }
    launch_tiles(
        dev,
        "raster/blend",
        "blend_backward",
        points,
        pairs,
        defines={"SOFTMAX": int(not is_alpha), "MOVED": int(moves)},
        limit=weights.limit,
        pair_key=pairs.pair_key,
        distortion_weight=distortion_weight,
        tile_shown=weights.tile_shown,
        point_slot=weights.point_slot,
        sample_state=weights.sample_state,
        sample_end=weights.sample_end if is_alpha else weights.sample_tracked,
        features=None if is_alpha else features,
        grad_features=grad_features,
        grad_alpha=grad_alpha,
        depth_gradient=depth_gradient,
        distortion=b.distortion,
        **of_pairs,
    )
    dev.program("raster/gather", LANES=lanes(dev), MOVED=int(moves), **points.macros()).launch(
        "gather_pairs",
        weights.total * row_parts(dev),
        s=weights.total,
        is_recorded=max_weight is not None,
        voxel_size=voxel_size,
        radius=points.radius,
        visible=weights.visible_rows,
        camera=points.camera_buffer,
        point_record=points.point_record,
        cloud_offset=points.cloud_offset,
        grad_opacity=b.grad_opacity,
        grad_offset=b.grad_offset if moves else None,
        max_weight=max_weight,
        **of_pairs,
    )
    return BlendGradients(
        b.grad_visible_features,
        b.grad_opacity,
        b.grad_offset if moves else None,
        b.distortion if distortion_weight > 0 else None,
    )
