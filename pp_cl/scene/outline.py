"""Contact sheets for checking a scene: outlines of the points over images, and wrong masks."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from skimage.segmentation import find_boundaries

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.training.target import Target
from pp_cl.engine.views import MASK_THRESHOLD, View, evenly
from pp_cl.files.image import to_8bit
from pp_cl.files.sheets import contact_sheet
from pp_cl.scene.agreement import Disagreement
from pp_cl.scene.hull import Hull, silhouette
from pp_cl.scene.image_file import shrink

SHOWN_VIEWS, SHOWN_SIZE = 12, 320  # images of the sheet, and their longer side in pixels
OUTLINE = (255, 0, 160)  # a colour that few objects have
MASK_OUTLINE = (0, 150, 255)
REJECTED = np.array([127, 60, 0], np.uint8)  # added where a mask lacks a part of the object


def outline(grid: Grid, ids: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: the border of the silhouette, two pixels wide."""
    return find_boundaries(silhouette(grid, ids, camera), mode="thick")


def outline_sheet(
    dev: Device,
    views: Sequence[View],
    points: Hull | None,
    disagreeing: Sequence[Disagreement] = (),
) -> np.ndarray:
    """uint8 (H, W, 3) contact sheet of up to 12 views over white, with the outlines of the mask and
    of the points. Views of `disagreeing` come first, tinted where they reject places that the
    others agree on.
    """
    target, images = Target(dev), []
    tinted = {disagreement.view.name: disagreement for disagreement in disagreeing[:SHOWN_VIEWS]}
    others = [view for view in views if view.name not in tinted]
    shown = [disagreement.view for disagreement in tinted.values()] + evenly(
        others, SHOWN_VIEWS - len(tinted)
    )
    for view in shown:
        small = view.near_size(SHOWN_SIZE)
        image = to_8bit(target.whole(small))
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
