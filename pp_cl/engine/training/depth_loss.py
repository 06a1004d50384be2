"""The depth loss, which keeps surfaces from bending between pixels (cl/training/depth_loss.cl)."""

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.raster.weights import BlendWeights


def depth_loss_table(pixels: int) -> Table:
    """The buffers of depth_gradient() for an image of this many pixels."""
    return {"surface": ((pixels, 4), np.float32), "depth_gradient": ((pixels, 2), np.float32)}


def depth_gradient(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    weights: BlendWeights,
    size: tuple[int, int],
    *,
    voxel_size: float,
    weight: float,
) -> Array:
    """The gradient of weight times the depth loss of an image composited by alpha, as
    blend_backward() takes it: (HW, 2) float32, for each pixel dL/db of a fragment over the
    difference of its range and the pixel's mean one, and this mean, world units.

    size: (H, W). voxel_size: world units.
    """
    pixels = size[0] * size[1]
    b.require(depth_loss_table(pixels))
    program = dev.program("training/depth_loss", SUPERSAMPLING=points.supersampling)
    program.launch(
        "pixel_surface",
        pixels,
        hw=pixels,
        voxel_size=voxel_size,
        camera=points.camera_buffer,
        transmittance=weights.transmittance,
        mean_range=weights.mean_range,
        surface=b.surface,
    )
    program.launch(
        "depth_gradient",
        pixels,
        h=size[0],
        w=size[1],
        weight=weight,
        surface=b.surface,
        depth_gradient=b.depth_gradient,
    )
    return b.depth_gradient
