"""Pictures for checking a scene: the outline of the points drawn over photographs, and where masks
disagree.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from skimage.morphology import closing, disk
from skimage.segmentation import find_boundaries

from pp_cl.device.device import Device
from pp_cl.files.contact_sheet import contact_sheet
from pp_cl.files.image import to_8bit
from pp_cl.scene.agreement import Disagreement
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.scene.hull import Hull, spacing_pixels
from pp_cl.scene.target import Target
from pp_cl.scene.views import MASK_THRESHOLD, View, evenly, fitting_downscale, shrink

SHOWN_VIEWS, SHOWN_SIZE = 12, 320  # photographs of the picture, and their longer side in pixels
OUTLINE = (255, 0, 160)  # a colour that few objects have
MASK_OUTLINE = (0, 150, 255)
REJECTED = np.array([127, 60, 0], np.uint8)  # added to what a mask should have held


def silhouette(grid: Grid, ids: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: the pixels that the points with these ids (N,) cover, gaps between neighbours
    closed.
    """
    gap = math.ceil(spacing_pixels(grid, [camera])) + 1
    x, y, depth = project(camera, grid.positions(ids))
    columns, rows = np.floor(x) + gap, np.floor(y) + gap
    marked = np.zeros((camera.height + 2 * gap, camera.width + 2 * gap), bool)
    inside = (depth > 0) & (columns >= 0) & (columns < marked.shape[1])
    inside &= (rows >= 0) & (rows < marked.shape[0])
    marked[rows[inside].astype(int), columns[inside].astype(int)] = True
    return closing(marked, disk(gap))[gap:-gap, gap:-gap]


def outline(grid: Grid, ids: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: the border of the silhouette, two pixels wide."""
    return find_boundaries(silhouette(grid, ids, camera), mode="thick")


def project(camera: Camera, positions: np.ndarray) -> np.ndarray:
    """(3, N) float64: x and y in pixels and the depth of (N, 3) world positions; those that are not
    in front of the camera are in its centre.
    """
    right, down, depth = camera.pose[:, :3].T @ (positions - camera.eye).T
    ahead = np.where(depth > 0, depth, np.inf)
    return np.stack(
        [camera.fx * right / ahead + camera.cx, camera.fy * down / ahead + camera.cy, depth]
    )


def picture(
    dev: Device,
    views: Sequence[View],
    points: Hull | None,
    disagreeing: Sequence[Disagreement] = (),
) -> np.ndarray:
    """uint8 (H, W, 3) contact sheet of up to 12 photographs over white, spread evenly over the
    views, with the outlines of the mask and, over it, of the points drawn over them.

    disagreeing: their views come first, tinted where they reject what the others agree on.
    """
    target, images = Target(dev), []
    tinted = {one.view.name: one for one in disagreeing[:SHOWN_VIEWS]}
    others = [view for view in views if view.name not in tinted]
    shown = [one.view for one in tinted.values()] + evenly(others, SHOWN_VIEWS - len(tinted))
    for view in shown:
        size = view.stored_camera.width, view.stored_camera.height
        small = view.reduced(fitting_downscale(size, SHOWN_SIZE))
        target.load(small)
        image = to_8bit(target.whole())
        if view.name in tinted:
            rejected = silhouette(*tinted[view.name][2:], small.camera)
            image[rejected] = image[rejected] // 2 + REJECTED
        if view.has_mask:
            mask = shrink(view.image, small.downscale)[..., 3] > MASK_THRESHOLD
            image[find_boundaries(mask, mode="inner")] = MASK_OUTLINE
        if points:
            image[outline(points.grid, points.ids, small.camera)] = OUTLINE
        images.append(image)
    return contact_sheet(images, [Path(view.name).name for view in shown])
