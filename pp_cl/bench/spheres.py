"""Spheres anywhere, as Pulsar has them, beside the engine's points on a grid."""

import math

from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.device import Device
from pp_cl.engine.raster.pairs import Pairs, capacity_needed, find_pairs
from pp_cl.engine.raster.project import ProjectedPoints, launch_projection, projection_table
from pp_cl.engine.raster.weights import BlendWeights


def project_spheres(
    dev: Device,
    b: Buffers,
    footprint: str,
    camera_buffer: Array,
    positions: Array,
    *,
    point_radius: Array,
    side: int = 1,
) -> ProjectedPoints:
    """Project points anywhere. positions: (N, 3) float32, world. point_radius: (N,). side: of
    project_grid().
    """
    n = len(positions)
    b.require(projection_table(n, footprint))
    launch_projection(
        dev,
        b,
        "bench/project_spheres",
        "project_spheres",
        n,
        footprint,
        side,
        camera=camera_buffer,
        positions=positions,
        point_radius=point_radius,
    )
    return ProjectedPoints(
        footprint,
        camera_buffer,
        b.point_camera,
        b.point_box,
        b.point_count,
        b.block_sum,
        b.point_shape,
        b.point_opacity,
        side=side,
    )


def find_all_pairs(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    size: tuple[int, int],
    capacity: int = 1,
    times_seen: Array | None = None,
) -> Pairs:
    """What find_pairs() returns with room for all; `capacity` is tried first."""
    while True:
        pairs = find_pairs(dev, b, points, size, capacity, times_seen)
        pairs.read_count(dev)
        capacity = capacity_needed(pairs)
        if capacity == pairs.capacity:
            return pairs
        del pairs  # else its arrays would stay beside the larger ones


def spheres_backward(
    dev: Device,
    points: ProjectedPoints,
    pairs: Pairs,
    weights: BlendWeights,
    pair_gradient: Array,
    *,
    opacity: Array,
    gamma: float,
) -> tuple[Array, Array]:
    """(grad_positions (N, 3) in world axes, grad_radius (N,)), after blend_backward()."""
    n = pairs.points
    grad_positions, grad_radius = dev.empty((n, 3)), dev.empty((n,))
    dev.program("bench/spheres").launch(
        "spheres_backward",
        n,
        n=n,
        # alpha depends on the order of the fragments alone
        gamma=math.inf if weights.blend == "alpha" else gamma,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        point_shape=points.point_shape,
        opacity=opacity,
        point_is_visible=weights.point_is_visible,
        point_offset=pairs.point_offset,
        pair_pixel=pairs.pair_pixel,
        pair_point_falloff=pairs.pair_point_falloff,
        pair_gradient=pair_gradient,
        grad_positions=grad_positions,
        grad_radius=grad_radius,
    )
    return grad_positions, grad_radius
