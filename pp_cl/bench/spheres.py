"""Renders spheres at any position, as Pulsar does; the engine's points lie on a grid."""

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
    """Project points at any position. positions: (N, 3) float32, world. point_radius: (N,). side:
    as in project_grid().
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
    """find_pairs() with room for all pairs; it tries `capacity` first."""
    while True:
        pairs = find_pairs(dev, b, points, size, capacity, times_seen)
        pairs.read_count(dev)
        capacity = capacity_needed(pairs)
        if capacity == pairs.capacity:
            return pairs
        del pairs  # frees its arrays before the larger ones are made


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
    """(grad_positions (N, 3) in world axes, grad_radius (N,)); call it after blend_backward()."""
    n = pairs.points
    grad_positions, grad_radius = dev.empty((n, 3)), dev.empty((n,))
    dev.program("bench/spheres").launch(
        "spheres_backward",
        n,
        n=n,
        # alpha depends on depths only by the order of the fragments
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
