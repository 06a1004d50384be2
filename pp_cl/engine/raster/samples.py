"""Launches the kernels of images whose pixels have several samples: discs composited by alpha."""

from __future__ import annotations

from typing import Any

from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import launch_groups
from pp_cl.engine.raster.footprint import footprint_macros
from pp_cl.engine.raster.pairs import Pairs
from pp_cl.engine.raster.project import ProjectedPoints


def sample_macros(dev: Device, pairs: Pairs, derivatives: bool = True) -> dict[str, Any]:
    """The defines of cl/raster/samples.cl, which computes the samples of a pixel in its lanes."""
    macros: dict[str, Any] = footprint_macros(pairs.footprint, pairs.side)
    on_cpu = {"ON_CPU": 1} if dev.is_cpu else {}
    return macros | on_cpu | {"LANES": pairs.side**2, "DERIVATIVES": int(derivatives)}


def sampled_weights(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    pairs: Pairs,
    derivatives: bool,
    **arguments: Any,
) -> Array | None:
    """Compute the blend weights of all pairs, which are means over a pixel's samples; returns
    BlendWeights.sample_transmittance. b: of blend_weights(). arguments: those that alpha_weights
    has, too.
    """
    transmittances = b.sample_transmittance if derivatives else None
    dev.program("raster/samples", **sample_macros(dev, pairs, derivatives)).launch(
        "sampled_weights",
        pairs.pixels,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        point_shape=points.point_shape,
        pair_point=pairs.pair_point_falloff,
        sample_derivative=b.pixel_derivative if derivatives else None,
        transmittance=b.transmittance,
        sample_transmittance=transmittances,
        **arguments,
    )
    return transmittances


def sampled_gradient(
    dev: Device,
    pairs: Pairs,
    opacity: Array,
    derivative: Array | None,
    transmittance: Array | None,
    *,
    span: int,
    **arguments: Any,
) -> None:
    """Write pair_gradient for blend_backward(). derivative, transmittance: by sample, of
    BlendWeights. span: pixels that share a sum of the distortion loss. arguments: those that
    alpha_gradient has, too.
    """
    launch_groups(
        dev,
        "raster/samples",
        "sampled_gradient",
        -(-pairs.pixels // span),
        most=span,
        defines=sample_macros(dev, pairs) | {"SPAN": span},
        opacity=opacity,
        sample_derivative=derivative,
        sample_transmittance=transmittance,
        **arguments,
    )


def sampled_offsets(
    dev: Device,
    points: ProjectedPoints,
    pairs: Pairs,
    visible: Array,
    count: int,
    opacity: Array,
    voxel_size: float,
    b: Buffers,
) -> None:
    """Write b.grad_offset, (S, 4), from b.pair_gradient as blend_backward() leaves it. visible:
    uint32, the visible points, S = count of them.
    """
    dev.program("raster/sampled_offsets", **sample_macros(dev, pairs)).launch(
        "sampled_offsets",
        count,
        s=count,
        voxel_size=voxel_size,
        visible=visible,
        camera=points.camera_buffer,
        point_camera=points.point_camera,
        point_shape=points.point_shape,
        opacity=opacity,
        point_offset=pairs.point_offset,
        pair_pixel=pairs.pair_pixel,
        pair_gradient=b.pair_gradient,
        grad_offset=b.grad_offset,
    )
