"""Spheres anywhere, as Pulsar has them, beside the engine's points on a grid: their projection, and
the gradients of their positions and radii, which no training needs.
"""

import math

from pyopencl.array import Array

from pp_cl.device.buffers import Buffers
from pp_cl.device.device import Device
from pp_cl.device.launch import lanes
from pp_cl.raster.pairs import Pairs, find_pairs, room_needed
from pp_cl.raster.project import FOOTPRINTS, ProjectedPoints, projection_table
from pp_cl.raster.weights import BlendWeights


def project_spheres(
    dev: Device,
    b: Buffers,
    footprint: str,
    camera_buffer: Array,
    positions: Array,
    *,
    point_radius: Array,
) -> ProjectedPoints:
    """Project points anywhere. positions: (N, 3) float32, world. point_radius: (N,)."""
    n = len(positions)
    b.require(projection_table(n))
    program = dev.program("raster/project", LANES=lanes(dev), FOOTPRINT=FOOTPRINTS.index(footprint))
    program.launch(
        "project_spheres",
        -(-n // lanes(dev)),
        n=n,
        camera=camera_buffer,
        positions=positions,
        point_radius=point_radius,
        point_camera=b.point_camera,
        point_box=b.point_box,
        point_count=b.point_count,
    )
    return ProjectedPoints(
        footprint, camera_buffer, b.point_camera, b.point_box, b.point_count, point_radius
    )


def find_all_pairs(
    dev: Device, b: Buffers, points: ProjectedPoints, size: tuple[int, int], room: int = 1
) -> Pairs:
    """The hits in an image of size (height, width), with room for all, tried first with `room`.
    Waits for the device. Raises UserError as room_needed() does.
    """
    while True:
        pairs = find_pairs(dev, b, points, size, room)
        room = room_needed(pairs)
        if room == pairs.capacity:
            return pairs
        del pairs  # else its arrays would stay beside the larger ones


def spheres_backward(
    dev: Device,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    b: Buffers,
    *,
    opacity: Array,
    gamma: float,
    shaded_features: Array,
    grad_features: Array,
    mean: bool = False,
) -> tuple[Array, Array]:
    """(grad_positions (N, 3) in world axes, grad_radius (N,)) float32 of explicit spheres.

    points, pairs, weights, opacity (N,), gamma, shaded_features (S, 16): those of the forward pass.
    b, grad_features (H, W, 16): of blend_backward(), which has run. mean: divide a point's
    gradients by its number of tracked pixels, as Pulsar does.
    """
    n, is_alpha = pairs.points, weights.blend == "alpha"
    program = dev.program(
        "bench/spheres",
        HAS_ROLES=int(weights.has_roles),
        HAS_PAIR_GAIN=int(is_alpha),
        MEAN=int(mean),
    )
    grad_pair = dev.empty(weights.pair_weight.shape)
    grad_positions, grad_radius = dev.empty((n, 3)), dev.empty((n,))
    program.launch(
        "spheres_backward_pairs",
        n,
        n=n,
        point_slot=weights.point_slot,
        shaded_features=shaded_features,
        point_offset=pairs.point_offset,
        pair_pixel=pairs.pair_pixel,
        pair_weight=weights.pair_weight,
        pair_role=weights.pair_role,
        pair_gain=b.pair_gain,
        pixel_rest=b.pixel_rest,
        grad_features=grad_features,
        pair_point_closeness=pairs.pair_point_closeness,
        grad_pair=grad_pair,
    )
    program.launch(
        "spheres_backward",
        n,
        n=n,
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
