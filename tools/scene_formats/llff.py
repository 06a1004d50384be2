"""A scene as LLFF has it: poses_bounds.npy, images/, and masks/."""

from pathlib import Path

import numpy as np

from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.scene.readers.llff import LLFF_FROM_CV
from tools.scene_formats.common import number, one_lens, ordered, write_mask, write_rgb

BOUNDS = (0.01, 100.0)  # of depths, in distances of the nearest camera from the origin


def write(folder: Path, splits: dict[str, list[View]]) -> None:
    """Write the views. Raises UserError for views with different intrinsics, a principal point off
    the middle or pixels that are not square, and for splits other than those that readers hold out.
    """
    views, rows = ordered(splits), []
    lens = one_lens(views, "LLFF")
    if lens.fx != lens.fy or (lens.cx, lens.cy) != (lens.width / 2, lens.height / 2):
        raise UserError("LLFF has square pixels and the principal point in the middle")
    size = [lens.height, lens.width, lens.fx]
    nearest = min(np.linalg.norm(view.stored_camera.eye) for view in views)
    for i, view in enumerate(views):
        camera = view.stored_camera
        write_rgb(folder / "images" / f"{number(i)}.png", view)
        write_mask(folder / "masks" / f"{number(i)}.png", view)
        pose = np.column_stack([camera.pose[:, :3] @ LLFF_FROM_CV.T, camera.eye, size])
        rows.append(np.append(pose.ravel(), nearest * np.array(BOUNDS)))
    np.save(folder / "poses_bounds.npy", np.array(rows))
