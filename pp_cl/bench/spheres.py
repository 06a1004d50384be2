"""Gradients of the positions and radii of spheres, which Pulsar has and no training needs: for
parity with it.
"""

import math

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.raster.pairs import Pairs
from pp_cl.raster.project import ProjectedPoints
from pp_cl.raster.weights import BlendWeights


def spheres_backward(
    dev: Device,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    pair_gain: Array,
    *,
    opacity: Array,
    gamma: float,
    mean: bool = False,
) -> tuple[Array, Array]:
    """(grad_positions (N, 3) in world axes, grad_radius (N,)) float32 of explicit spheres.

    points, pairs, weights, opacity (N,), gamma: those of the forward pass. pair_gain: (P,), of
    blend_backward(). mean: divide a point's gradients by its number of tracked pixels, as Pulsar
    does.
    """
    n = pairs.points
    program = dev.program("bench/spheres", HAS_ROLES=int(weights.has_roles), MEAN=int(mean))
    grad_pair = dev.empty(weights.pair_weight.shape)
    grad_positions, grad_radius = dev.empty((n, 3)), dev.empty((n,))
    program.launch(
        "spheres_backward_pairs",
        n,
        n=n,
        point_offset=pairs.point_offset,
        pair_weight=weights.pair_weight,
        pair_role=weights.pair_role,
        pair_gain=pair_gain,
        pair_point_closeness=pairs.pair_point_closeness,
        grad_pair=grad_pair,
    )
    is_alpha = weights.transmittance is not None
    program.launch(
        "spheres_backward",
        n,
        n=n,
        radii=points.point_radius.size,
        gamma=math.inf if is_alpha else gamma,  # alpha depends on the order of the hits alone
        camera=points.camera_buffer,
        point_radius=points.point_radius,
        point_camera=points.point_camera,
        opacity=opacity,
        point_offset=pairs.point_offset,
        pair_pixel=pairs.pair_pixel,
        grad_pair=grad_pair,
        grad_positions=grad_positions,
        grad_radius=grad_radius,
    )
    return grad_positions, grad_radius
